"""Formats that are only written: Graphviz DOT, the net files of the model checker LoLA, and DRN for
the model checker Storm.

DOT shows a net. LoLA (its grammar: `ParserPTNetLoLA.yy` of LoLA 2) has places, weighted arcs and
tokens alone. DRN ("direct encoding", see Storm's documentation of its explicit input) holds the
chain of a GSPN over its tangible markings as a CTMC.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from petrobot.coordinator.analysis.formats.netfile import NetFile, NetFileError, unused
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


LOLA_NAME = re.compile(
    r"(?!(?:PLACE|SAFE|MARKING|TRANSITION|WEAK|STRONG|FAIR|CONSUME|PRODUCE)\Z)[A-Za-z_][A-Za-z0-9_.]*"
)
"""Names that both the net files and the formulas of LoLA allow, and no keyword of the net files."""


def write_lola(model: NetFile) -> str:
    """Return a net for LoLA. Raises NetFileError.

    LoLA's `SAFE k` is a promise, not a rule, so a place of capacity c gets a complementary place
    that holds c minus its tokens, which loses no behaviour (Murata 1989, section II). On it stand
    the inhibitor arcs of that place, too: fewer than k tokens are at least c - k + 1 free ones.
    """
    model, _ = model.with_names(LOLA_NAME)
    net = model.net
    if not net.places or not net.transitions:
        what = "transitions" if net.places else "places"
        raise NetFileError("lola", what, "the net has none", "LoLA reads no net without any")
    taken, free = {*net.places, *net.transitions}, dict[int, str]()
    for p, most in enumerate(net.capacity):
        if most is not None:
            if net.initial[p] > most:
                found = f"{net.initial[p]} tokens are more than its capacity {most}"
                raise NetFileError("lola", f"place {net.places[p]}", found, "raise the capacity")
            free[p] = unused(f"{net.places[p]}.free", taken)
            taken.add(free[p])
    tokens = dict(zip(net.places, net.initial, strict=True))
    tokens |= {name: (net.capacity[p] or 0) - net.initial[p] for p, name in free.items()}
    lines = [f"PLACE {', '.join(tokens)};", f"MARKING {_lola_list(tokens)};"]
    for t, name in enumerate(net.transitions):
        taking = {net.places[p]: w for p, w in net.consume[t]}
        giving = {net.places[p]: w for p, w in net.produce[t]}
        below = dict(net.inhibit[t])
        for p, other in free.items():
            gain = giving.get(net.places[p], 0) - taking.get(net.places[p], 0)
            most = net.capacity[p] or 0
            needed = max(gain, most + 1 - below.get(p, most + 1), 0)
            taking[other], giving[other] = needed, needed - gain
        lines += [
            f"TRANSITION {name}",
            f"  CONSUME {_lola_list(taking)};",
            f"  PRODUCE {_lola_list(giving)};",
        ]
    return "\n".join(lines) + "\n"


def _lola_list(numbers: Mapping[str, int]) -> str:
    return ", ".join(f"{name}: {number}" for name, number in numbers.items() if number)


def write_drn(chain: Chain) -> str:
    """Return the DRN text of a chain.

    States are labelled `init`, `deadlock`, and with the name of each marked place, in which
    everything but letters, digits and _ is replaced by _. A number follows if two would be alike.

    A CTMC starts in one state. A chain whose first tangible marking is drawn is a Markov automaton:
    its last state takes no time and leads to them.
    """
    made = Generator.of(chain)
    starts = np.flatnonzero(made.start).tolist()
    drawn = len(starts) > 1
    count = str(len(made.tangible) + drawn)
    rates = (made.matrix.T * made.rate).tocsr()
    marked = np.stack(
        [chain.space.tokens(p)[made.tangible] > 0 for p in range(len(chain.space.net.places))]
    )
    names, taken = list[str](), {"init", "deadlock"}
    for name in chain.space.net.places:
        names.append(unused(_identifier(name), taken))
        taken.add(names[-1])
    lines = [
        "// A GSPN's chain over its tangible markings, rates in 1/s",
        "@type: Markov Automaton" if drawn else "@type: CTMC",
        "@parameters",
        "",
        "@reward_models",
        "",
    ]
    lines += [
        "@nr_states",
        count,
        "@nr_choices",
        count,
        "@model",
    ]
    for i in range(len(made.tangible)):
        first, last = rates.indptr[i], rates.indptr[i + 1]
        out = [
            (int(j), float(r))
            for j, r in zip(rates.indices[first:last], rates.data[first:last], strict=True)
            if j != i
        ]
        out = [(j, r) for j, r in sorted(out) if r > 0]
        total = sum(r for _, r in out)
        labels = [names[p] for p in np.flatnonzero(marked[:, i]).tolist()]
        labels = (["init"] if starts == [i] else []) + (["deadlock"] if not out else []) + labels
        lines.append(f"state {i} !{total or 1.0!r} {' '.join(labels)}".rstrip())
        lines.append("\taction 0")
        unit = total if drawn else 1.0  # the edges of a Markov automaton are probabilities
        lines += [f"\t\t{j} : {r / unit!r}" for j, r in out] or [f"\t\t{i} : 1.0"]
    if drawn:
        lines += [f"state {len(made.tangible)} !0 init", "\taction 0"]
        lines += [f"\t\t{i} : {float(made.start[i])!r}" for i in starts]
    return "\n".join(lines) + "\n"


def _identifier(name: str) -> str:
    clean = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in name)
    return clean if clean[:1].isalpha() or clean[:1] == "_" else f"p_{clean}"
