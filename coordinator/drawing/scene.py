"""What there is to draw: nodes with their words, arcs with their ends, before anything has a place on the paper."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from coordinator.drawing.layout import Point, lay_out
from coordinator.net import Marking, Net
from coordinator.task import End, Kind, Place, Scope, Task, Transition

RADIUS = 21.0
BAR = (4.0, 21.0)
"""Half thickness and half length of a transition."""
TURNS = 4
"""Firings of one transition that are numbered along a path."""


@dataclass(frozen=True, slots=True)
class Node:
    """A place or a transition. `style` are its CSS classes; `lines` stand beside it, `hint` is its tooltip."""

    name: str
    is_place: bool
    at: Point
    style: str
    lines: tuple[str, ...]
    hint: str
    tokens: int = 0
    hidden: int = 0
    """Folded error exits."""
    upright: bool = True
    """Transitions: the bar stands."""
    heat: float | None = None
    """How warm its halo is, 0 to 1."""
    turns: str = ""
    """Transitions: when they fire along a path, such as "2, 5"."""

    @property
    def half(self) -> tuple[float, float]:
        """Half width and half height."""
        if self.is_place:
            return RADIUS, RADIUS
        return BAR if self.upright else (BAR[1], BAR[0])


@dataclass(frozen=True, slots=True)
class Overlay:
    """What is told over a drawing: a halo for each place or transition (0 to 1), and a path of firings, numbered."""

    heat: Mapping[str, float] = field(default_factory=dict)
    path: Sequence[str] = ()
    legend: str = ""

    def on(self, node: Node) -> Node:
        """The node with what is told of it; what lies inside a macro place is told of that place."""
        heat = [h for name, h in self.heat.items() if node.name in (name, name.partition(".")[0])]
        turns = [str(i) for i, name in enumerate(self.path, 1) if node.name in (name, name.partition(".")[0])]
        if not heat and not turns:
            return node
        share = min(1.0, sum(heat)) if heat else None
        hint = node.hint + (f": {100 * share:.0f} %" if share is not None else "")
        shown = turns if len(turns) <= TURNS else [*turns[: TURNS - 1], f"… {turns[-1]}"]
        return replace(node, heat=share, turns=", ".join(shown), hint=hint)


@dataclass(frozen=True, slots=True)
class Arc:
    """An arc by node names. `kind`: plain, normal, error, preempt, going, inhibitor."""

    source: str
    target: str
    weight: int = 1
    kind: str = "plain"
    style: str = ""


@dataclass(frozen=True, slots=True)
class Scene:
    """Everything on the paper."""

    title: str
    text: str
    nodes: Mapping[str, Node]
    arcs: tuple[Arc, ...] = field(default=())
    legend: str = ""

    def under(self, overlay: Overlay) -> Scene:
        """The same scene with an overlay."""
        nodes = {name: overlay.on(node) for name, node in self.nodes.items()}
        return replace(self, nodes=nodes, legend=overlay.legend)


def scene_of_task(task: Task, error_branches: bool, marking: Marking | None, title: str | None) -> Scene:
    """The scene of a task as its file has it."""
    folded = frozenset() if error_branches else _folded(task)
    places = {n: p for n, p in task.places.items() if n not in folded}
    transitions = {n: t for n, t in task.transitions.items() if n not in folded}
    arcs = tuple(
        a for t in transitions.values() for a in _task_arcs(task, t) if {a.source, a.target}.isdisjoint(folded)
    )
    wanted = {n: _given(p.x, p.y) for n, p in places.items()} | {n: _given(t.x, t.y) for n, t in transitions.items()}
    at = lay_out(wanted, [(a.source, a.target) for a in arcs], [n for n, p in places.items() if p.tokens])
    tokens = _tokens(task, marking)
    nodes = {n: _place_node(task, p, at[n], tokens.get(n, 0), folded) for n, p in places.items()}
    nodes |= {n: _transition_node(task, t, at, arcs) for n, t in transitions.items()}
    return Scene(title or task.name, task.text or task.goal or "Petri net of a robot task", nodes, arcs)


def _folded(task: Task) -> frozenset[str]:
    """Error branches, and the places that nothing else touches."""
    errors = task.error_elements
    touched: dict[str, list[bool]] = {}
    for t in task.transitions.values():
        names = [a.place for a in t.inputs] + [a.place for a in t.outputs] + [a.place for a in t.inhibitors]
        for name in names:
            touched.setdefault(name, []).append(t.name in errors)
    return errors | {place for place, hidden in touched.items() if all(hidden)}


def scene_of_net(net: Net, marking: Marking | None, title: str | None) -> Scene:
    """The scene of an ordinary net."""
    arcs: list[Arc] = []
    for t, name in enumerate(net.transitions):
        arcs += [Arc(net.places[p], name, w) for p, w in net.consume[t]]
        arcs += [Arc(name, net.places[p], w) for p, w in net.produce[t]]
        arcs += [Arc(net.places[p], name, k, "inhibitor") for p, k in net.inhibit[t]]
    tokens = marking or net.initial
    wanted: dict[str, Point | None] = dict.fromkeys((*net.places, *net.transitions))
    at = lay_out(
        wanted, [(a.source, a.target) for a in arcs], [p for p, n in zip(net.places, tokens, strict=True) if n]
    )
    nodes = {
        p: Node(p, True, at[p], "place resource", (p,), f"place {p}", n)
        for p, n in zip(net.places, tokens, strict=True)
    }
    nodes |= {
        t: Node(t, False, at[t], "transition", (t,), f"transition {t}", upright=_upright(t, at, arcs))
        for t in net.transitions
    }
    return Scene(title or "Petri net", net.describe(tokens), nodes, tuple(arcs))


def _given(x: float | None, y: float | None) -> Point | None:
    return None if x is None or y is None else (x, y)


def _tokens(task: Task, marking: Marking | None) -> dict[str, int]:
    """Tokens by drawn place; a macro place shows those of all its subnet's places."""
    net = task.net
    tokens: dict[str, int] = {}
    for name, n in zip(net.places, marking or net.initial, strict=True):
        for shown in {name, name.partition(".")[0]}:
            tokens[shown] = tokens.get(shown, 0) + n
    return tokens


def _task_arcs(task: Task, t: Transition) -> Iterable[Arc]:
    error = t.name in task.error_elements
    for a in t.inputs:
        kind = a.end.value if a.end is not None else "plain"
        yield Arc(a.place, t.name, a.weight, kind, "error" if error else "")
    for i in t.inhibitors:
        yield Arc(i.place, t.name, i.threshold, "inhibitor", "error" if error else "")
    for o in t.outputs:
        yield Arc(t.name, o.place, o.weight, "plain", "error" if error else "")


def _place_node(task: Task, p: Place, at: Point, tokens: int, folded: frozenset[str]) -> Node:
    hidden = sum(any(a.place == p.name for a in task.transitions[t].inputs) for t in folded & set(task.transitions))
    what = {
        Kind.ACTION: f"action place, primitive task {p.task}",
        Kind.RESOURCE: "resource place",
        Kind.CONTROL: "control place: the operator may change its tokens",
        Kind.MACRO: f"macro place, subnet {p.subnet}",
    }[p.kind]
    lines = [p.label or p.name]
    if p.kind is Kind.ACTION and p.task != p.name:
        lines.append(f"({p.task})")
    capacity = f", at most {p.capacity}" if p.capacity is not None else ""
    hint = f"{p.name}: {what}{capacity}"
    style = f"place {p.kind}" + (" error" if p.name in task.error_elements else "")
    return Node(p.name, True, at, style, tuple(lines), hint, tokens, hidden)


def _transition_node(task: Task, t: Transition, at: Mapping[str, Point], arcs: Iterable[Arc]) -> Node:
    style = "transition" + (" error" if t.name in task.error_elements else "")
    hint = f"transition {t.name}"
    if t.priority:
        hint += f", priority {t.priority}"
    if t.weight is not None:
        hint += f", weight {t.weight:g}"
    return Node(t.name, False, at[t.name], style, event_lines(task, t), hint, upright=_upright(t.name, at, arcs))


def event_lines(task: Task, t: Transition) -> tuple[str, ...]:
    """The words at a transition: what must happen, with the prefixes int and ext of the paper's figures."""
    lines: list[str] = []
    for name in t.events:
        lines.append(f"{'ext' if task.events[name].scope is Scope.EXTERNAL else 'int'} {name}")
    words = t.label or t.name.replace("_", " ")
    ends = any(a.end in (End.NORMAL, End.ERROR) for a in t.inputs)
    if t.after is not None:
        lines.append(f"{words}: after {t.after:g} s")
    elif not t.events:
        lines.append(f"int {words}" if ends else words)
    if t.when is not None:
        lines.append(f"[{t.when}]")
    return tuple(lines)


def _upright(name: str, at: Mapping[str, Point], arcs: Iterable[Arc]) -> bool:
    """Whether most of a transition's arcs come from the sides, so that its bar stands."""
    across = down = 0.0
    x, y = at[name]
    for arc in arcs:
        if name in (arc.source, arc.target):
            ox, oy = at[arc.target if arc.source == name else arc.source]
            size = max(abs(ox - x), abs(oy - y), 1.0)
            across, down = across + abs(ox - x) / size, down + abs(oy - y) / size
    return across >= down
