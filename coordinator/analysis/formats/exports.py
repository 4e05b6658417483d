"""Formats that are only written: Graphviz DOT, and DRN for the model checker Storm.

DOT shows a net or its reachability graph. DRN ("direct encoding", see Storm's documentation of its
explicit input) holds the chain of a GSPN over its tangible markings as a CTMC.
"""

from __future__ import annotations

import numpy as np

from petrobot.coordinator.analysis.formats.netfile import NetFile, NetFileError
from petrobot.coordinator.analysis.net.space import Space
from petrobot.coordinator.analysis.time.gspn import Chain
from petrobot.coordinator.analysis.time.markov import Generator


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def write_dot(model: NetFile) -> str:
    """Return a net as DOT: circles, boxes (filled if immediate), inhibitor arcs with a round
    head."""
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
    """Return a reachability graph as DOT: the initial marking bold, dead markings filled."""
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


def write_drn(chain: Chain) -> str:
    """Return the DRN text of a chain. Raises NetFileError if its initial marking is vanishing.

    States are labelled `init`, `deadlock`, and with the name of each marked place, in which
    everything but letters, digits and _ is replaced by _.
    """
    if chain.vanishing[0]:
        remedy = "a CTMC starts in a tangible marking; give the first transition a rate"
        raise NetFileError("drn", "init", "the initial marking is vanishing", remedy)
    made = Generator.of(chain)
    rates = (made.matrix.T * made.rate).tocsr()
    marked = np.stack(
        [chain.space.tokens(p)[made.tangible] > 0 for p in range(len(chain.space.net.places))]
    )
    names = [_identifier(name) for name in chain.space.net.places]
    lines = [
        "// A GSPN's chain over its tangible markings, rates in 1/s",
        "@type: CTMC",
        "@parameters",
        "",
        "@reward_models",
        "",
    ]
    lines += [
        "@nr_states",
        str(len(made.tangible)),
        "@nr_choices",
        str(len(made.tangible)),
        "@model",
    ]
    for i, n in enumerate(made.tangible.tolist()):
        first, last = rates.indptr[i], rates.indptr[i + 1]
        out = [
            (int(j), float(r))
            for j, r in zip(rates.indices[first:last], rates.data[first:last], strict=True)
            if j != i
        ]
        out = [(j, r) for j, r in sorted(out) if r > 0]
        total = sum(r for _, r in out)
        labels = [names[p] for p in np.flatnonzero(marked[:, i]).tolist()]
        labels = (["init"] if n == 0 else []) + (["deadlock"] if not out else []) + labels
        lines.append(f"state {i} !{total or 1.0!r} {' '.join(labels)}".rstrip())
        lines.append("\taction 0")
        lines += [f"\t\t{j} : {r!r}" for j, r in out or [(i, 1.0)]]
    return "\n".join(lines) + "\n"


def _identifier(name: str) -> str:
    clean = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in name)
    return clean if clean[:1].isalpha() or clean[:1] == "_" else f"p_{clean}"
