// What words of the drawing cover, counted in the page; run by test_designer.py.
() => {
  const { view } = petrobot.tabs.Design;
  const world = (node) => { const b = node.getBBox(), e = view.elements.get(node.closest("[data-name]").dataset.name); return [b.x + e.x, b.y + e.y, b.x + b.width + e.x, b.y + b.height + e.y]; };
  const words = [...view.svg.querySelectorAll(".label, .sub")].filter((n) => n.textContent).map(world);
  const bodies = [...view.svg.querySelectorAll(".element .body")].map(world);
  const over = (a, b) => a[0] + 1 < b[2] && b[0] + 1 < a[2] && a[1] + 3 < b[3] && b[1] + 3 < a[3];
  const pairs = (list, others) => list.reduce((n, a, i) => n + others.filter((b, j) => (list !== others || j > i) && over(a, b)).length, 0);
  const lines = [...view.arcs.values()].map((arc) => arc.parts.line).map((line) => Array.from({ length: 60 }, (_, i) => line.getPointAtLength((line.getTotalLength() * i) / 59)));
  const struck = words.filter((w) => lines.some((line) => line.some((p) => p.x > w[0] && p.x < w[2] && p.y > w[1] + 4 && p.y < w[3] - 4))).length;
  return { words: words.length, words_on_words: pairs(words, words), words_on_elements: pairs(words, bodies), elements_on_elements: pairs(bodies, bodies), struck };
}
