"""What a drawing shows: nodes with labels and positions, arcs between them, before routing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.drawing.layout import Edge, Point, lay_out, lay_out_blocks
from petrobot.coordinator.task import End, Kind, Place, Scope, Task, Transition
from petrobot.coordinator.task.expansion import macros_around, net_inside, with_error_branches
from petrobot.coordinator.task.net import Marking, Net
from petrobot.coordinator.task.wording import listed

# Which part of a task is drawn: all of it with its macro places closed, or the inside of one.


class Sheet(Struct, frozen=True):
    """One level of a task: the whole, or the inside of a macro place.

    `task` is the net that it is part of: the task itself, or one with the net of a subnet.
    """

    task: Task
    places: Mapping[str, Place]
    transitions: Mapping[str, Transition]
    border: frozenset[str]
    """Transitions around the opened macro place, drawn to show where tokens come from and go."""
    folded: frozenset[str]
    """Elements of the net that are hidden because only error branches reach them."""
    shown: Mapping[str, str]
    """What each place of the net is drawn as on this sheet: itself or a macro place around it."""
    tokens: Mapping[str, int]
    prefix: str = ""
    """Prefix of the names of the net in the flat task."""


def sheet_of(task: Task, inside: str, error_branches: bool, marking: Marking | None) -> Sheet:
    """Return the sheet of a macro place, named as in the flat task (`fetch.grasp`).

    "" stands for the whole task. Raises ValueError if there is no such macro place.
    """
    net, prefix, group = _opened(task, inside)
    shown = dict(_shown(net, group))
    folded = frozenset() if error_branches else _folded(net)
    inner = {t for t in net.transitions.values() if t.macro == group}
    border = {
        t
        for t in net.transitions.values()
        if t not in inner and not set(_joined(t)).isdisjoint(shown)
    }
    outside = frozenset(
        t.name for t in border if group and group not in macros_around(t.macro, net.places)
    )
    return Sheet(
        task=net,
        places={n: net.places[n] for n in dict.fromkeys(shown.values()) if n not in folded},
        transitions={
            n: t
            for n, t in net.transitions.items()
            if (t in inner or n in outside) and n not in folded
        },
        border=outside,
        folded=folded,
        shown=shown,
        tokens=_tokens(task, net, marking, prefix, shown),
        prefix=prefix,
    )


def expanded(task: Task) -> Task:
    """Return the net that is executed, to be drawn: nothing is written in short and no macro place
    is closed. It gets a new layout if elements were added, or stood in a macro place."""
    flat = task.flat
    elements: list[Place | Transition] = [*flat.places.values(), *flat.transitions.values()]
    drawn_as_written = not any(element.macro for element in elements)
    if drawn_as_written and {*flat.places, *flat.transitions} == {*task.places, *task.transitions}:
        return task
    return replace(
        flat,
        places={n: replace(p, macro="", x=None, y=None) for n, p in flat.places.items()},
        transitions={n: replace(t, macro="", x=None, y=None) for n, t in flat.transitions.items()},
    )


def _opened(task: Task, inside: str) -> tuple[Task, str, str]:
    """Return the net of a macro place, the prefix of its names in the flat task, and its group. It
    has the error branches that `[errors]` adds.

    The group is "" if the whole net is shown. Raises ValueError.
    """
    net, prefix, group = with_error_branches(task), "", ""
    for part in inside.split(".") if inside else ():
        place = net.places.get(part)
        if place is None or place.kind is not Kind.MACRO or group:
            known = ", ".join(n for n, p in net.places.items() if p.kind is Kind.MACRO)
            raise ValueError(
                f"{task.name} has no macro place {inside!r}; it has {known or 'none'} at that level"
            )
        if place.subnet:
            net = net_inside(task, place)
            prefix = f"{prefix}{part}."
        else:
            group = part
    return net, prefix, group


def _shown(net: Task, group: str) -> Iterator[tuple[str, str]]:
    """Yield what each place within the group is drawn as on the sheet of the group."""
    for place in net.places.values():
        around = [place.name, *macros_around(place.macro, net.places)]
        if not group:
            yield place.name, around[-1]
        elif group in around[1:]:
            yield place.name, around[around.index(group) - 1]


def _joined(t: Transition) -> Iterable[str]:
    return (
        *(a.place for a in t.inputs),
        *(a.place for a in t.outputs),
        *(a.place for a in t.inhibitors),
    )


def _folded(net: Task) -> frozenset[str]:
    """Return the hidden elements: error branches, and what only they touch or contain."""
    hidden = set(net.error_elements)
    touched: dict[str, list[bool]] = {}
    for t in net.transitions.values():
        for name in _joined(t):
            touched.setdefault(name, []).append(t.name in hidden)
    hidden |= {place for place, by in touched.items() if all(by)}
    held: dict[str, list[bool]] = {}
    elements: list[Place | Transition] = [*net.places.values(), *net.transitions.values()]
    for element in elements:
        if not (isinstance(element, Place) and element.kind is Kind.MACRO):
            for macro in macros_around(element.macro, net.places):
                held.setdefault(macro, []).append(element.name in hidden)
    return frozenset(hidden | {macro for macro, inside in held.items() if all(inside)})


def _tokens(
    task: Task, net: Task, marking: Marking | None, prefix: str, shown: Mapping[str, str]
) -> dict[str, int]:
    """Return the tokens by drawn place; a macro place shows those of all places inside it. Tokens
    that a short form adds (`grip.left`: how many tries are left) are no runs and are not shown."""
    tokens: dict[str, int] = {}
    for name, n in zip(task.net.places, marking or task.net.initial, strict=True):
        own = name.removeprefix(prefix) if name.startswith(prefix) else ""
        if name in task.net.counters and own not in net.places:
            continue
        head = own if own in net.places else own.partition(".")[0]
        here = shown.get(head)
        if here is not None and (head == own or net.places[head].kind is Kind.MACRO):
            tokens[here] = tokens.get(here, 0) + n
    return tokens


RADIUS = 21.0
BAR = (4.0, 21.0)
"""Half thickness and half length of a transition."""
BOX = 8.0
"""Half thickness of a timed transition: a box, as usual for GSPNs; immediate ones are bars."""
TURNS = 4
"""The most firings of one transition that are numbered along a path."""


class DrawnNode(Struct, frozen=True):
    """A place or a transition: `style` are its CSS classes, `lines` its label, `hint` its
    tooltip."""

    name: str
    is_place: bool
    at: Point
    style: str
    lines: tuple[str, ...]
    hint: str
    tokens: int = 0
    hidden: int = 0
    """Number of hidden error transitions that leave it."""
    upright: bool = True
    """Transitions only: the bar is vertical."""
    heat: float | None = None
    """Intensity of its halo, 0 to 1; None for no halo."""
    turns: str = ""
    """Transitions only: when they fire along a path, such as "2, 5"."""

    @property
    def half(self) -> tuple[float, float]:
        """Half width and half height."""
        if self.is_place:
            return RADIUS, RADIUS
        thickness = BOX if "timed" in self.style.split() else BAR[0]
        return (thickness, BAR[1]) if self.upright else (BAR[1], thickness)


class Caption(Struct, frozen=True):
    """Label, tooltip and CSS classes of one node of a net."""

    lines: tuple[str, ...]
    hint: str
    style: str = ""


class Blocks(Struct, frozen=True):
    """The element of a flat task (`of`) that each node of a net stands for in part: the net is laid
    out as the task is."""

    task: Task
    of: Mapping[str, str]


class Overlay(Struct, frozen=True):
    """Information drawn over a scene: halos of places or transitions (0 to 1), a path of
    firings."""

    heat: Mapping[str, float] = field(default_factory=dict)
    path: Sequence[str] = ()
    legend: str = ""
    moving: Mapping[Edge, float] = field(default_factory=dict)
    """Tokens on arcs: by the two ends of an arc, how far its token has come, 0 to 1."""

    def on(self, node: DrawnNode, shown: Mapping[str, str]) -> DrawnNode:
        """Return the node with its overlay.

        A closed macro place receives the overlay of everything inside it (`shown`).
        """
        heat = [h for name, h in self.heat.items() if node.name == shown.get(name, name)]
        turns = [
            str(i) for i, name in enumerate(self.path, 1) if node.name == shown.get(name, name)
        ]
        if not heat and not turns:
            return node
        share = min(1.0, sum(heat)) if heat else None
        hint = node.hint + (f": {100 * share:.0f} %" if share is not None else "")
        told = turns if len(turns) <= TURNS else [*turns[: TURNS - 1], f"… {turns[-1]}"]
        return replace(node, heat=share, turns=", ".join(told), hint=hint)


class Arc(Struct, frozen=True):
    """An arc between two nodes. `kind`: plain, normal, error, preempt, going or inhibitor."""

    source: str
    target: str
    weight: int = 1
    kind: str = "plain"
    style: str = ""


class Scene(Struct, frozen=True):
    """Everything in a drawing."""

    title: str
    text: str
    nodes: Mapping[str, DrawnNode]
    arcs: tuple[Arc, ...] = ()
    through: Mapping[Edge, Sequence[Point]] = field(default_factory=dict)
    """Points through which the layout leads an arc, by its two ends."""
    legend: str = ""
    shown: Mapping[str, str] = field(default_factory=dict)
    """Places and transitions that are drawn as another node: the macro place around them."""
    moving: Mapping[Edge, float] = field(default_factory=dict)
    """Tokens on arcs, as in `Overlay`."""

    def under(self, overlay: Overlay) -> Scene:
        """Return the scene with an overlay."""
        nodes = {name: overlay.on(node, self.shown) for name, node in self.nodes.items()}
        moving = {
            (self.shown.get(a, a), self.shown.get(b, b)): way
            for (a, b), way in overlay.moving.items()
        }
        return replace(self, nodes=nodes, legend=overlay.legend, moving=moving)


def scene_of_task(
    task: Task, error_branches: bool, marking: Marking | None, title: str | None, inside: str = ""
) -> Scene:
    """Return the scene of a task, or of the inside of a macro place.

    Raises ValueError if there is no such macro place.
    """
    sheet = sheet_of(task, inside, error_branches, marking)
    arcs = tuple(_joined_arcs(sheet))
    drawn: dict[str, Place | Transition] = {**sheet.places, **sheet.transitions}
    wanted = {n: _given(e.x, e.y) if n not in sheet.border else None for n, e in drawn.items()}
    # By the initial tokens: whatever the marking, a net is laid out alike, also in a film.
    tokens = sheet_of(task, inside, error_branches, None).tokens
    layout = lay_out(
        wanted,
        [(a.source, a.target) for a in arcs],
        [n for n in sheet.places if tokens.get(n)],
        {n for n, p in sheet.places.items() if p.kind is Kind.RESOURCE and tokens.get(n)},
    )
    at = layout.at
    nodes = {n: _place_node(sheet, p, at[n]) for n, p in sheet.places.items()}
    nodes |= {n: _transition_node(sheet, t, at, arcs) for n, t in sheet.transitions.items()}
    heading = title or (f"{task.name}: {inside}" if inside else task.name)
    return Scene(
        heading,
        task.text or task.goal or "Petri net of a robot task",
        nodes,
        arcs,
        layout.through,
        shown=_elsewhere(sheet),
    )


def _elsewhere(sheet: Sheet) -> dict[str, str]:
    """Return by name in the flat task the node that it is drawn as."""
    net = sheet.task
    shown = {sheet.prefix + name: here for name, here in sheet.shown.items()}
    for name, t in net.flat.transitions.items():
        around = next(
            (m for m in macros_around(t.macro, net.places) if m in sheet.places),
            name.partition(".")[0],
        )
        shown[sheet.prefix + name] = name if name in sheet.transitions else around
    for name in net.flat.places:
        head = name.partition(".")[0]
        shown.setdefault(sheet.prefix + name, sheet.shown.get(head, head))
    return shown


def scene_of_net(
    net: Net,
    marking: Marking | None,
    title: str | None,
    captions: Mapping[str, Caption] | None = None,
    blocks: Blocks | None = None,
) -> Scene:
    """Return the scene of a net; captions replace the names of some nodes."""
    arcs: list[Arc] = []
    for t, name in enumerate(net.transitions):
        arcs += [Arc(net.places[p], name, w) for p, w in net.consume[t]]
        arcs += [Arc(name, net.places[p], w) for p, w in net.produce[t]]
        arcs += [Arc(net.places[p], name, k, "inhibitor") for p, k in net.inhibit[t]]
    tokens = marking or net.initial
    edges = [(a.source, a.target) for a in arcs]
    if blocks is None:
        wanted: dict[str, Point | None] = dict.fromkeys((*net.places, *net.transitions))
        marked = [p for p, n in zip(net.places, tokens, strict=True) if n]
        layout = lay_out(wanted, edges, marked)
    else:
        drawn = scene_of_task(expanded(blocks.task), True, None, None).nodes
        layout = lay_out_blocks(blocks.of, {name: drawn[name].at for name in drawn}, edges)
    at = layout.at
    captions = captions or {}
    nodes: dict[str, DrawnNode] = {}
    for name, n in zip(net.places, tokens, strict=True):
        said = captions.get(name, Caption((name,), f"place {name}", "resource"))
        nodes[name] = DrawnNode(
            name, True, at[name], f"place {said.style}", said.lines, said.hint, n
        )
    for name in net.transitions:
        said = captions.get(name, Caption((name,), f"transition {name}"))
        style = f"transition {said.style}".rstrip()
        upright = _upright(name, at, arcs)
        nodes[name] = DrawnNode(
            name, False, at[name], style, said.lines, said.hint, upright=upright
        )
    return Scene(title or "Petri net", net.describe(tokens), nodes, tuple(arcs), layout.through)


def _given(x: float | None, y: float | None) -> Point | None:
    return None if x is None or y is None else (x, y)


def _joined_arcs(sheet: Sheet) -> Iterable[Arc]:
    """Return the arcs of the sheet.

    Arcs of the same kind between the same two drawn nodes become one; their weights are added up.
    """
    joined: dict[tuple[str, str, str], Arc] = {}
    for t in sheet.transitions.values():
        for arc in _task_arcs(sheet, t):
            key = (arc.source, arc.target, arc.kind)
            before = joined.get(key)
            joined[key] = arc if before is None else replace(arc, weight=before.weight + arc.weight)
    return [a for a in joined.values() if a.source in sheet.places or a.target in sheet.places]


def _task_arcs(sheet: Sheet, t: Transition) -> Iterable[Arc]:
    style = "error" if t.name in sheet.task.error_elements else ""
    shown = sheet.shown
    for a in t.inputs:
        if a.place in shown:
            yield Arc(
                shown[a.place],
                t.name,
                a.weight,
                a.end.value if a.end is not None else "plain",
                style,
            )
    for i in t.inhibitors:
        if i.place in shown:
            yield Arc(shown[i.place], t.name, i.threshold, "inhibitor", style)
    for o in t.outputs:
        if o.place in shown:
            yield Arc(t.name, shown[o.place], o.weight, "plain", style)


def _place_node(sheet: Sheet, p: Place, at: Point) -> DrawnNode:
    task = sheet.task
    exits = [task.transitions[t] for t in sheet.folded & set(task.transitions)]
    inside = {
        n for n in task.places if p.name in (n, *macros_around(task.places[n].macro, task.places))
    }
    hidden = sum(t.macro not in inside and any(a.place in inside for a in t.inputs) for t in exits)
    what = {
        Kind.ACTION: f"action place, primitive task {p.task}",
        Kind.RESOURCE: "resource place",
        Kind.CONTROL: "control place: the operator may change its tokens",
        Kind.PLAIN: "place",
        Kind.MACRO: f"macro place, subnet {p.subnet}"
        if p.subnet
        else f"macro place of {listed(inside - {p.name})}",
    }[p.kind]
    runs = p.task if p.kind is Kind.ACTION and p.task != p.name else ""
    under = ", ".join(filter(None, (p.subnet, runs, task.in_short(p))))
    capacity = f", at most {p.capacity}" if p.capacity is not None else ""
    hint = f"{p.name}: {what}{capacity}"
    style = f"place {p.kind}" + (" error" if p.name in task.error_elements else "")
    return DrawnNode(
        p.name,
        True,
        at,
        style,
        tuple(filter(None, (p.label or p.name, under))),
        hint,
        sheet.tokens.get(p.name, 0),
        hidden,
    )


def _transition_node(
    sheet: Sheet, t: Transition, at: Mapping[str, Point], arcs: Iterable[Arc]
) -> DrawnNode:
    task = sheet.task
    style = "transition" + (" error" if t.name in task.error_elements else "")
    style += " outside" if t.name in sheet.border else ""
    hint = f"transition {t.name}"
    if t.priority:
        hint += f", priority {t.priority}"
    if t.weight is not None:
        hint += f", weight {t.weight:g}"
    return DrawnNode(
        t.name,
        False,
        at[t.name],
        style,
        event_lines(task, t),
        hint,
        upright=_upright(t.name, at, arcs),
    )


def event_lines(task: Task, t: Transition) -> tuple[str, ...]:
    """Return the label of a transition: what must happen before it fires.

    The prefixes int and ext (internal, external event) are those of the figures in the paper.
    """
    lines: list[str] = []
    for name in t.events:
        lines.append(f"{'ext' if task.events[name].scope is Scope.EXTERNAL else 'int'} {name}")
    words = t.label or t.name
    ends = any(a.end in (End.NORMAL, End.ERROR) for a in t.inputs)
    if t.after is not None:
        lines.append(f"{words}: after {t.after:g} s")
    elif not t.events:
        lines.append(f"int {words}" if ends else words)
    if t.when is not None:
        lines.append(f"[{t.when}]")
    return tuple(lines)


def _upright(name: str, at: Mapping[str, Point], arcs: Iterable[Arc]) -> bool:
    """Return whether most arcs of a transition come from the sides, so its bar is vertical."""
    across = down = 0.0
    x, y = at[name]
    for arc in arcs:
        if name in (arc.source, arc.target):
            ox, oy = at[arc.target if arc.source == name else arc.source]
            size = max(abs(ox - x), abs(oy - y), 1.0)
            across, down = across + abs(ox - x) / size, down + abs(oy - y) / size
    return across >= down
