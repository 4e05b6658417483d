"""Drawings of tasks and nets as SVG text, readable on light and dark backgrounds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import atan2, cos, hypot, sin
from xml.sax.saxutils import escape

from petrobot.coordinator.drawing.layout import Point
from petrobot.coordinator.drawing.routing import (
    FONT,
    LINE,
    ArcPath,
    LabelBox,
    badge_spot,
    place_words,
    route,
)
from petrobot.coordinator.drawing.scene import (
    RADIUS,
    Blocks as Blocks,
    Caption as Caption,
    DrawnNode,
    Overlay as Overlay,
    Scene,
    expanded as expanded,
    scene_of_net,
    scene_of_task,
)
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.net import Marking, Net


def draw(
    model: Task | Net,
    *,
    error_branches: bool = False,
    marking: Marking | None = None,
    title: str | None = None,
    overlay: Overlay | None = None,
    inside: str = "",
    captions: Mapping[str, Caption] | None = None,
    blocks: Blocks | None = None,
) -> str:
    """Return the SVG text of a task or net.

    Macro places stay closed, and error branches are hidden unless `error_branches`; a badge on a
    place counts its hidden outgoing transitions. `marking` (of `Task.net`, or of the net) replaces
    the initial tokens. `overlay` colours nodes and numbers the firings of a path. `inside` opens a
    macro place, named as in the flat task; raises ValueError if there is none. `captions` replace
    the labels of the nodes of a net, `blocks` lay it out as a task.
    """
    scene = (
        scene_of_net(model, marking, title, captions, blocks)
        if isinstance(model, Net)
        else scene_of_task(model, error_branches, marking, title, inside)
    )
    return render(scene.under(overlay) if overlay else scene)


# --- writing a scene ---

_MARGIN = 24.0
_DOTS: dict[int, tuple[Point, ...]] = {
    1: ((0, 0),),
    2: ((-6.5, 0), (6.5, 0)),
    3: ((0, -6.5), (-6.5, 5), (6.5, 5)),
    4: ((-6.5, -6.5), (6.5, -6.5), (-6.5, 6.5), (6.5, 6.5)),
}
_STYLE = """
.page{fill:#ffffff}
text{font:12.5px system-ui,-apple-system,"Segoe UI","DejaVu Sans",sans-serif;fill:#1c2430}
.event{fill:#4a5568}
.place{fill:#ffffff;stroke:#1c2430;stroke-width:1.6}
.place.action{fill:#e8f1fd;stroke:#1b5fb4}
.ring{fill:none;stroke:#1b5fb4;stroke-width:1.2}
.place.resource{fill:#eef7ee;stroke:#2c7a3f}
.place.control{fill:#fdf4e3;stroke:#a86a00;stroke-dasharray:5 2.5}
.place.macro{fill:#f2ecfb;stroke:#6b3fb0;stroke-width:2.4}
.place.error{stroke:#c0262d}
.transition{fill:#1c2430}
.transition.error{fill:#c0262d}
.transition.timed{fill:#ffffff;stroke:#1c2430;stroke-width:1.6}
.outside{fill-opacity:.35}
.token{fill:#1c2430}
.count{font-weight:600}
.arc{fill:none;stroke:#4a5568;stroke-width:1.3}
.arc.preempt{stroke:#a86a00}
.arc.going{stroke-dasharray:1.5 3}
.arc.error{stroke:#c0262d;stroke-dasharray:6 3}
.head{fill:#4a5568}
.head.preempt{fill:#a86a00}
.head.error{fill:#c0262d}
.bar{fill:#ffffff;stroke:#4a5568;stroke-width:1.3}
.bar.error{stroke:#c0262d}
.weight{font-size:11px}
.halo{stroke:#ffffff;stroke-width:3.5px;stroke-linejoin:round}
.warm{fill:#e8590c}
.turn{fill:#7a1fa2;font-size:11px;font-weight:700}
.fired{fill:none;stroke:#7a1fa2;stroke-width:2.4}
.legend{font-size:12px}
.badge{fill:#c0262d}
.badge-text{fill:#ffffff;font-size:10px;font-weight:700}
@media (prefers-color-scheme:dark){
.page{fill:#12161d}
text{fill:#e6eaf0}
.event{fill:#aab4c3}
.place{fill:#12161d;stroke:#e6eaf0}
.place.action{fill:#16283f;stroke:#79b0f5}
.ring{stroke:#79b0f5}
.place.resource{fill:#15281a;stroke:#7fcf92}
.place.control{fill:#2e2412;stroke:#e5b04f}
.place.macro{fill:#241a36;stroke:#b795f0}
.place.error{stroke:#ff7b81}
.transition,.token{fill:#e6eaf0}
.transition.error,.head.error{fill:#ff7b81}
.transition.timed{fill:#12161d;stroke:#e6eaf0}
.arc{stroke:#aab4c3}
.arc.preempt{stroke:#e5b04f}
.arc.error{stroke:#ff7b81}
.head{fill:#aab4c3}
.head.preempt{fill:#e5b04f}
.bar{fill:#12161d;stroke:#aab4c3}
.bar.error{stroke:#ff7b81}
.halo{stroke:#12161d}
.turn{fill:#d7a6f0}
.fired{stroke:#d7a6f0}
}
"""


def render(scene: Scene) -> str:
    """Return the scene as a complete SVG document."""
    paths = route(scene)
    words = place_words(scene.nodes, paths)
    left, top, width, height = _frame(scene, paths, words)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{left:g} {top:g} {width:g} {height:g}" '
        f'width="{width:g}" height="{height:g}" role="img" aria-labelledby="title desc">',
        f'<title id="title">{escape(scene.title)}</title>',
        f'<desc id="desc">{escape(_description(scene))}</desc>',
        f"<style>{_STYLE}</style>",
        f'<rect class="page" x="{left:g}" y="{top:g}" width="{width:g}" height="{height:g}"/>',
    ]
    lines += [line for path in paths for line in _arc(path)]
    lines += [
        line for node in scene.nodes.values() for line in _node(node, badge_spot(node, paths))
    ]
    lines += [line for w in words for line in _words(w)]
    lines += [line for path in paths if path.arc.weight > 1 for line in _weight(path)]
    lines += [
        _moving(path, scene.moving[ends])
        for path in paths
        if (ends := (path.arc.source, path.arc.target)) in scene.moving
    ]
    if scene.legend:
        lines += _text(
            scene.legend, left + _MARGIN / 2, top + height - _MARGIN / 2, "start", "legend"
        )
    return "\n".join([*lines, "</svg>", ""])


def _description(scene: Scene) -> str:
    places = [n for n in scene.nodes.values() if n.is_place]
    marked = ", ".join(f"{n.name} {n.tokens}" for n in places if n.tokens)
    count = f"{len(places)} places, {len(scene.nodes) - len(places)} transitions"
    return f"{scene.text}. {count}. Tokens: {marked or 'none'}."


def _frame(
    scene: Scene, paths: Sequence[ArcPath], words: Sequence[LabelBox]
) -> tuple[float, float, float, float]:
    """Return left, top, width and height of a frame around everything."""
    points = [
        (n.at[0] + sx * (n.half[0] + 8), n.at[1] + sy * (n.half[1] + 8))
        for n in scene.nodes.values()
        for sx, sy in ((-1, -1), (1, 1))
    ]
    points += [point for path in paths for point in path.points]
    points += [p for w in words for p in ((w.box[0], w.box[1]), (w.box[2], w.box[3]))]
    xs, ys = [x for x, _ in points] or [0.0], [y for _, y in points] or [0.0]
    left, top = round(min(xs) - _MARGIN), round(min(ys) - _MARGIN)
    width = max(round(max(xs) + _MARGIN) - left, round(6.2 * len(scene.legend)))
    return left, top, width, round(max(ys) + _MARGIN + (LINE if scene.legend else 0.0)) - top


def _node(node: DrawnNode, badge: Point) -> Iterator[str]:
    (x, y), (w, h) = node.at, node.half
    yield f'<g id="{escape(node.name, {chr(34): "&quot;"})}"><title>{escape(node.hint)}</title>'
    yield from _told(node)
    if node.is_place:
        yield f'<circle class="{node.style}" cx="{x:g}" cy="{y:g}" r="{RADIUS:g}"/>'
        if "action" in node.style.split() or "macro" in node.style.split():
            ring = "ring" if "action" in node.style.split() else node.style
            yield (
                f'<circle class="{ring}" style="fill:none" cx="{x:g}" cy="{y:g}" '
                f'r="{RADIUS - 4:g}"/>'
            )
        yield from _tokens(node)
        yield from _badge(node, badge)
    else:
        yield (
            f'<rect class="{node.style}" x="{x - w:g}" y="{y - h:g}" width="{2 * w:g}" '
            f'height="{2 * h:g}" rx="1"/>'
        )
    yield "</g>"


def _told(node: DrawnNode) -> Iterator[str]:
    """Yield the overlay of a node: a coloured halo, and when a transition fires along a path."""
    (x, y), (w, h) = node.at, node.half
    if node.heat is not None:
        shape = f'width="{2 * w + 20:g}" height="{2 * h + 20:g}" rx="{w + 10:g}"'
        opacity = 0.06 + 0.84 * node.heat
        yield (
            f'<rect class="warm" fill-opacity="{opacity:.2f}" x="{x - w - 10:g}" '
            f'y="{y - h - 10:g}" {shape}/>'
        )
    if node.turns:
        yield (
            f'<rect class="fired" x="{x - w - 4:g}" y="{y - h - 4:g}" '
            f'width="{2 * w + 8:g}" height="{2 * h + 8:g}" rx="5"/>'
        )
        yield from _text(node.turns, x + w + 8, y - h - 4, "start", "turn")


def _tokens(node: DrawnNode) -> Iterator[str]:
    x, y = node.at
    if node.tokens > 4:
        yield (
            f'<text class="count" x="{x:g}" y="{y + 4.5:g}" '
            f'text-anchor="middle">{node.tokens}</text>'
        )
        return
    for dx, dy in _DOTS.get(node.tokens, ()):
        yield f'<circle class="token" cx="{x + dx:g}" cy="{y + dy:g}" r="4.2"/>'


def _moving(path: ArcPath, way: float) -> str:
    """Return a token on its way along an arc."""
    x, y = path.point(way)
    return f'<circle class="token" cx="{x:.1f}" cy="{y:.1f}" r="5.5"/>'


def _badge(node: DrawnNode, spot: Point) -> Iterator[str]:
    if node.hidden:
        x, y = spot
        what = f"{node.hidden} error transition{'s' * (node.hidden > 1)} hidden"
        yield f'<g><title>{what}</title><circle class="badge" cx="{x:g}" cy="{y:g}" r="7.5"/>'
        yield (
            f'<text class="badge-text" x="{x:g}" y="{y + 3.5:g}" '
            f'text-anchor="middle">{node.hidden}</text></g>'
        )


def _arc(path: ArcPath) -> Iterator[str]:
    (x1, y1), (cx, cy), (x2, y2) = path.start, path.controls[-1], path.end
    style = " ".join(filter(None, (path.arc.kind, path.arc.style)))
    direction = atan2(y2 - cy, x2 - cx)
    reach = 9.0 if path.arc.kind == "inhibitor" else 8.0
    ex, ey = x2 - reach * cos(direction), y2 - reach * sin(direction)
    curve = f"L{ex:.1f} {ey:.1f}" if path.is_straight else "".join(_pieces(path, (ex, ey)))
    yield f'<path class="arc {style}" d="M{x1:.1f} {y1:.1f}{curve}"/>'
    if path.arc.kind == "inhibitor":
        bx, by = x2 - 4.5 * cos(direction), y2 - 4.5 * sin(direction)
        yield f'<circle class="bar {style}" cx="{bx:.1f}" cy="{by:.1f}" r="4.5"/>'
        return
    wings = [
        (x2 - 10 * cos(direction + s * 0.4), y2 - 10 * sin(direction + s * 0.4)) for s in (-1, 1)
    ]
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in ((x2, y2), *wings))
    yield f'<polygon class="head {style}" points="{points}"/>'


def _pieces(path: ArcPath, end: Point) -> Iterator[str]:
    for (_, _), (cx, cy), (x, y) in path.pieces(end):
        yield f"Q{cx:.1f} {cy:.1f} {x:.1f} {y:.1f}"


def _words(words: LabelBox) -> Iterator[str]:
    style = "" if words.node.is_place else "event"
    for i, line in enumerate(words.node.lines):
        yield from _text(line, words.x, words.y + i * LINE, words.anchor, style)


def _weight(path: ArcPath) -> Iterator[str]:
    x, y = path.point(0.5)
    (x1, y1), (x2, y2) = path.point(0.45), path.point(0.55)
    length = hypot(x2 - x1, y2 - y1) or 1.0
    x, y = x + (y2 - y1) / length * FONT * 0.7, y - (x2 - x1) / length * FONT * 0.7
    yield from _text(str(path.arc.weight), x, y + 4, "middle", "weight")


def _text(text: str, x: float, y: float, anchor: str, style: str) -> Iterator[str]:
    """Yield a text with a halo in the colour of the page.

    Two elements, because not every renderer supports `paint-order`.
    """
    where = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"'
    yield f'<text class="halo {style}" aria-hidden="true" {where}>{escape(text)}</text>'
    yield f'<text class="{style}" {where}>{escape(text)}</text>'
