"""Graphviz DOT out: a net, or its reachability graph."""

from __future__ import annotations

from petrobot.coordinator.analysis.formats.netfile import NetFile
from petrobot.coordinator.analysis.net.space import Space


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def write_dot(model: NetFile) -> str:
    """A net: circles with tokens, bars (filled if immediate), inhibitor arcs with a round head."""
    net = model.net
    lines = [f"digraph {_quoted(model.name or 'net')} {{", "  rankdir=LR;"]
    for p, name in enumerate(net.places):
        tokens = net.initial[p]
        shown = model.labels.get(name, name) + (f"\\n{tokens}" if tokens else "")
        lines.append(
            f"  {_quoted(name)} [shape=circle, "
            f"label={_quoted(shown).replace(chr(92) * 2 + 'n', chr(92) + 'n')}];"
        )
    for t, name in enumerate(net.transitions):
        shown = model.labels.get(name, name)
        filled = (
            ", style=filled, fillcolor=black, fontcolor=white"
            if model.gspn and model.gspn.rate[t] is None
            else ""
        )
        lines.append(f"  {_quoted('t:' + name)} [shape=box, label={_quoted(shown)}{filled}];")
    for t, name in enumerate(net.transitions):
        bar = _quoted("t:" + name)
        lines += [f"  {_quoted(net.places[p])} -> {bar}{_weight(w)};" for p, w in net.consume[t]]
        lines += [f"  {bar} -> {_quoted(net.places[p])}{_weight(w)};" for p, w in net.produce[t]]
        lines += [
            f"  {_quoted(net.places[p])} -> {bar}{_weight(w, 'arrowhead=odot')};"
            for p, w in net.inhibit[t]
        ]
    return "\n".join([*lines, "}"]) + "\n"


def _weight(weight: int, more: str = "") -> str:
    said = [more] if more else []
    said += [f"label={_quoted(str(weight))}"] if weight > 1 else []
    return f" [{', '.join(said)}]" if said else ""


def write_space_dot(space: Space) -> str:
    """A reachability graph: markings as nodes (the initial one bold, dead ones filled), edges
    labelled by transitions."""
    dead = set(space.dead.tolist())
    lines = ["digraph markings {"]
    for i in range(len(space)):
        style = "bold" if i == 0 else "filled" if i in dead else "solid"
        lines.append(
            f"  m{i} [label={_quoted(space.net.describe(space.marking(i)))}, style={style}];"
        )
    for i, j, t in zip(
        space.source.tolist(), space.target.tolist(), space.label.tolist(), strict=True
    ):
        lines.append(f"  m{i} -> m{j} [label={_quoted(space.net.transitions[t])}];")
    return "\n".join([*lines, "}"]) + "\n"
