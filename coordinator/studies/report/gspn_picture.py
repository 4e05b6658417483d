"""The stochastic view as SVG: timed transitions are boxes, immediate ones bars, each with its rate
or weight and where that comes from. A duration is drawn as one place and one box."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping

from petrobot.coordinator.analysis.formats.netfile import NetFile
from petrobot.coordinator.analysis.time.gspn import Gspn
from petrobot.coordinator.analysis.time.stochastic import StochasticView
from petrobot.coordinator.drawing import Blocks, Caption, Overlay, draw
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.net import Net


def gspn_svg(model: StochasticView | NetFile, legend: str, title: str = "") -> str:
    """Return the drawing of a net with rates. The stochastic view of a task is laid out as the
    task is, and each number says where it comes from. `title`: of a net without a name."""
    if isinstance(model, StochasticView):
        name, gspn, sources, chains = model.task.name, model.gspn, model.sources, model.chains
    else:
        assert model.gspn is not None
        name, gspn, sources, chains = model.name, model.gspn, {}, {}
    folded, names = folded_chains(gspn, chains)
    # In a GSPN of a task a place and a transition may have the same name; a drawing needs two.
    renamed, _ = NetFile(folded.net, gspn=folded).with_names(re.compile(".+", re.DOTALL))
    new_names = dict(zip(folded.net.transitions, renamed.net.transitions, strict=True))
    phases = Counter(chains.values())
    captions = {
        new_names[old]: _caption(folded, t, sources.get(names[old], ""), phases)
        for t, old in enumerate(folded.net.transitions)
    }
    blocks = None
    if isinstance(model, StochasticView):
        origins = {new: model.origin.get(names[old], "") for old, new in new_names.items()}
        blocks = blocks_of(renamed.net, origins, model.task)
    overlay = Overlay(legend=legend)
    return draw(renamed.net, title=name or title, captions=captions, overlay=overlay, blocks=blocks)


def folded_chains(gspn: Gspn, chains: Mapping[str, str]) -> tuple[Gspn, dict[str, str]]:
    """Return the net to draw, in which each chain is one place, and by name of its transitions one
    that it stands for.

    A drawing needs neither the steps from phase to phase nor for each phase a transition that
    removes it. Transitions by which a run enters one chain at different phases are one, too.
    """
    net = gspn.net
    places = [chains.get(place, place) for place in net.places]
    tokens = Counter[str]()
    for place, n in zip(places, net.initial, strict=True):
        tokens[place] += n
    arcs: dict[str, tuple[dict[str, int], dict[str, int]]] = {}
    inhibitors, priority = dict[str, dict[str, int]](), dict[str, int]()
    rates, weights, servers = dict[str, float](), dict[str, float](), dict[str, int | None]()
    same = dict[tuple[object, ...], tuple[str, int]]()
    names: dict[str, str] = {}
    for t, name in enumerate(net.transitions):
        need, give, bars = (
            {places[p]: n for p, n in of[t]} for of in (net.consume, net.produce, net.inhibit)
        )
        folds = [p for p, _ in (*net.consume[t], *net.produce[t]) if net.places[p] in chains]
        if folds and need == give:
            continue
        drawn = name
        for p in folds:
            drawn = drawn.replace(net.places[p], places[p])
        drawn = name if drawn in arcs else drawn
        rate, weight = gspn.rate[t], gspn.weight[t]
        if folds:
            like = (*map(_key, (need, give, bars)), rate is None)
            first, other = same.setdefault(like, (drawn, t))
            if other != t:
                if net.consume[other] == net.consume[t]:
                    share = rates if rate is not None else weights
                    share[first] += rate if rate is not None else weight
                continue
        arcs[drawn], inhibitors[drawn], names[drawn] = (need, give), bars, name
        priority[drawn], servers[drawn] = net.priority[t], gspn.servers[t]
        if rate is None:
            weights[drawn] = weight
        else:
            rates[drawn] = rate
    folded = Net.build(tokens, arcs, inhibitors=inhibitors, priority=priority)
    return Gspn.of(folded, rates, weights=weights, servers=servers), names


def blocks_of(net: Net, origins: Mapping[str, str], task: Task) -> Blocks:
    """Return for each node the element of the task that it stands for in part. A transition stands
    for the place of all its arcs, else for the transition of the task that it is a case of."""
    elements = {*task.flat.places, *task.flat.transitions}

    def named(name: str) -> str:
        while name and name not in elements:
            name = name.rpartition(".")[0]
        return name

    of = {place: named(place) or place for place in net.places}
    for t, name in enumerate(net.transitions):
        around = [of[net.places[p]] for p, _ in (*net.consume[t], *net.produce[t])]
        places = {block for block in around if block in elements}
        only = places.pop() if len(places) == 1 else ""
        of[name] = only or origins[name] or named(name) or next(iter(around), name)
    return Blocks(task, of)


def _key(arcs: Mapping[str, int]) -> frozenset[tuple[str, int]]:
    return frozenset(arcs.items())


def _caption(gspn: Gspn, t: int, source: str, phases: Mapping[str, int]) -> Caption:
    """Return what the drawing says of a transition."""
    net, rate, servers = gspn.net, gspn.rate[t], gspn.servers[t]
    name = net.transitions[t]
    need, give = ({net.places[p] for p, _ in arcs[t]} for arcs in (net.consume, net.produce))
    count = max((phases[place] for place in need - give if place in phases), default=1)
    if rate is not None:
        said = f"{rate:.4g}/s" if count == 1 else f"{count} phases of {rate:.4g}/s"
        if servers != 1:
            said += " for each token" if servers is None else f", {servers} servers"
    else:
        said = f"weight {gspn.weight[t]:.4g}" if source or gspn.weight[t] != 1.0 else ""
    kind = "immediate" if rate is None else "timed"
    hint = "; ".join(text for text in (f"{kind} transition {name}", said, source) if text)
    return Caption(tuple(text for text in (name, said, source) if text), hint, kind)
