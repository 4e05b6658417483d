// Arcs as a task file writes them: short texts in a transition's `in` and `out`.

const ARC = /^(!?)\s*([\p{L}\p{N}_.]+)(?::(\w+)(?:=(\w+))?)?(?:\s*\*\s*(\d+))?$/u;

/** One arc of `in` or `out`: {place, end, counts, weight, inhibit}; null when the text is none. */
export function readArc(text) {
  const found = ARC.exec(String(text).trim());
  return found ? { inhibit: Boolean(found[1]), place: found[2], end: found[3] ?? null, counts: found[4] ?? null, weight: Number(found[5] ?? 1) } : null;
}

export function writeArc({ place, end, counts, weight, inhibit }) {
  const way = end ? `:${end}${counts ? `=${counts}` : ""}` : "";
  return `${inhibit ? "!" : ""}${place}${inhibit ? "" : way}${weight > 1 ? `*${weight}` : ""}`;
}

/** A list, whatever a file has in its place: one text, or nothing. */
export const listed = (value) => (Array.isArray(value) ? value : value === undefined || value === "" ? [] : [value]);

/** All arcs of a transition, with their direction. */
export const arcsOf = (transition) => ["in", "out"].flatMap((key) => listed(transition[key]).map((text) => ({ text, arc: readArc(text), key }))).filter(({ arc }) => arc)
  .map(({ text, arc, key }) => ({ ...arc, text, direction: key === "out" ? "out" : arc.inhibit ? "inhibit" : "in" }));

/** Point the arcs of a transition elsewhere: `names` is a map of places; arcs whose place is in `dropped` go. */
export function repoint(transition, names, dropped = new Set()) {
  for (const key of ["in", "out"]) {
    if (!transition[key]) continue;
    transition[key] = listed(transition[key]).flatMap((text) => {
      const arc = readArc(text);
      if (!arc || (!names.has(arc.place) && !dropped.has(arc.place))) return [text];
      return dropped.has(arc.place) ? [] : [writeArc({ ...arc, place: names.get(arc.place) })];
    });
  }
}
