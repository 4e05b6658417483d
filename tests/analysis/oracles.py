"""Other tools as references (`pip install petrobot[oracle]`): SNAKES, pm4py and Storm solve the
same nets."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path
from typing import Any

from petrobot.coordinator.task.net import Net


def snakes_graph(net: Net, most: int) -> tuple[set[tuple[int, ...]], int] | None:
    """Return markings and number of edges by SNAKES 0.9; None above `most` markings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return _snakes_graph(net, most)


def _snakes_graph(net: Net, most: int) -> tuple[set[tuple[int, ...]], int] | None:
    from snakes.nets import (
        Inhibitor,
        MultiArc,
        PetriNet,
        Place,
        StateGraph,
        Transition,
        Value,
        dot,
    )

    model = PetriNet("net")
    for place, tokens in zip(net.places, net.initial, strict=True):
        model.add_place(Place(place, [dot] * tokens))
    for t, name in enumerate(net.transitions):
        model.add_transition(Transition(name))
        for arcs, add in ((net.consume[t], model.add_input), (net.produce[t], model.add_output)):
            for p, w in arcs:
                add(net.places[p], name, Value(dot) if w == 1 else MultiArc([Value(dot)] * w))
        for p, threshold in net.inhibit[t]:
            assert threshold == 1, "an inhibitor of SNAKES looks for one token"
            model.add_input(net.places[p], name, Inhibitor(Value(dot)))
    graph = StateGraph(model)
    for _ in graph:
        if len(graph) > most:
            return None
    markings = set()
    edges = 0
    for state in graph:
        marking = graph.net.get_marking() if graph.goto(state) is None else {}
        markings.add(tuple(len(marking.get(place, ())) for place in net.places))
        edges += len(list(graph.successors(state)))
    return markings, edges


def pm4py_markings(text: str, net: Net) -> set[tuple[int, ...]]:
    """Return the markings that pm4py reaches from a PNML text, by its own reader and firing
    rule."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pm4py
        from pm4py.objects.petri_net import semantics

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "net.pnml"
            path.write_text(text, encoding="utf-8")
            model, first, _ = pm4py.read_pnml(str(path), auto_guess_final_marking=False)
    seen, queue = {first}, [first]
    while queue:
        marking = queue.pop()
        for transition in semantics.enabled_transitions(model, marking):
            after = semantics.weak_execute(transition, marking)
            if after not in seen:
                seen.add(after)
                queue.append(after)
    by_name = {place.name: place for place in model.places}
    return {
        tuple(marking[by_name[place]] if place in by_name else 0 for place in net.places)
        for marking in seen
    }


def storm_share(text: str, label: str) -> float:
    """Return the long-run share of time in states with a label, by Storm, from a .drn text."""
    return _storm(text, f'LRA=? [ "{label}" ]')


def storm_time(text: str, label: str, asked: str = "T=?") -> float:
    """Return the mean time (s) until a state with a label, by Storm, from a .drn text."""
    return _storm(text, f'{asked} [ F "{label}" ]')


def _storm(text: str, asked: str) -> float:
    import stormpy

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "chain.drn"
        path.write_text(text, encoding="utf-8")
        model: Any = stormpy.build_model_from_drn(str(path))
    (formula,) = stormpy.parse_properties(asked)
    return float(stormpy.model_checking(model, formula).at(model.initial_states[0]))
