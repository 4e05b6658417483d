"""Compare the speed of the analysis with other tools in one run: states/s, firings/s, times of GSPN
solution and completion, and memory.

    python -m tools.bench.analysis            everything; tools that are not installed are named
    python -m tools.bench.analysis --quick    small nets only
    python -m tools.bench.analysis --write docs/figures-analysis.md    also write the page

Every measurement runs in a process of its own, so its peak memory is its own. Seconds are CPU
seconds without imports and compilation. Only figures of the same run are comparable: the ratios say
how many times longer the other tool takes.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from textwrap import fill
from typing import Any
from unittest import mock

ROOT = Path(__file__).parents[2]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from petrobot.coordinator.task.net import Net  # noqa: E402 - the repository's root comes first
from tests.analysis.generators import (  # noqa: E402
    KANBAN_RATES,
    fms,
    kanban,
    philosophers,
    robot_cell,
    shared_memory,
)

SPACES: dict[str, Callable[[], Net]] = {
    "kanban-2": lambda: kanban(2),
    "philosophers-10": lambda: philosophers(10),
    "kanban-4": lambda: kanban(4),
    "robot-cell-8": lambda: robot_cell(8, 3),
    "shared-memory-10": lambda: shared_memory(10),
    "fms-5": lambda: fms(5),
    "kanban-5": lambda: kanban(5),
    "robot-cell-8 of 5": lambda: robot_cell(8, 5),
}
"""Philosophers-10 and robot-cell-8 have some 50 places; the last has more than 5e6 markings."""
OTHERS_SKIP = ("robot-cell-8 of 5",)
"""Nets on which only our engines run: there the memory is what counts."""
QUICK = ("kanban-2", "philosophers-10")
JUDGED = ("kanban-2", "fms-5", "kanban-5")
"""Nets whose verdicts are measured, too."""
SLOW_STATES = 3_000
"""Markings after which the pure Python tools are stopped; their rate is what counts."""
EQUAL = 1e-7
"""Tolerance of our sweeps with which all measures are as precise as Storm's by default (1e-6)."""
CAPACITY = 15
"""Largest number of tokens in one place, as given to Storm: more than any of these nets reaches."""
NEEDS = {"snakes": "snakes", "pm4py": "pm4py", "storm": "stormpy"}
"""Packages that the other tools need."""


def timed(work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the CPU seconds of some work, and its result. CPU time, since other programs may use
    the machine; every tool here works in one thread."""
    start = time.process_time()
    said = work()
    return {"seconds": time.process_time() - start, **said}


# State spaces.


def space_ours(name: str, engine: str) -> dict[str, Any]:
    """Explore a net with one of our engines."""
    from petrobot.coordinator.analysis.net.space import explore

    net = SPACES[name]()
    explore(kanban(1), engine=engine)  # type: ignore[arg-type] # imports and compiles

    def work() -> dict[str, Any]:
        space = explore(net, engine=engine)  # type: ignore[arg-type]
        return {"states": len(space), "edges": space.edges}

    return timed(work)


def verdicts_ours(name: str) -> dict[str, Any]:
    """Explore a net and find all verdicts on it."""
    from petrobot.coordinator.analysis.net.qualitative import examine
    from petrobot.coordinator.analysis.net.space import explore

    net = SPACES[name]()
    examine(explore(kanban(1)))  # imports and compiles
    start = time.process_time()
    space = explore(net)
    explored = time.process_time() - start
    said = timed(lambda: {"live": examine(space).live.holds, "states": len(space)})
    return said | {"explored_seconds": explored}


def space_snakes(name: str) -> dict[str, Any]:
    """Explore a net with SNAKES; stop after SLOW_STATES markings."""
    from snakes.nets import MultiArc, PetriNet, Place, StateGraph, Transition, Value, dot

    net, model = SPACES[name](), PetriNet("net")
    for p, place in enumerate(net.places):
        model.add_place(Place(place, [dot] * net.initial[p]))
    for t, transition in enumerate(net.transitions):
        model.add_transition(Transition(transition))
        for arcs, add in ((net.consume[t], model.add_input), (net.produce[t], model.add_output)):
            for p, w in arcs:
                add(net.places[p], transition, Value(dot) if w == 1 else MultiArc([Value(dot)] * w))

    def work() -> dict[str, Any]:
        graph = StateGraph(model)
        for _ in graph:
            if len(graph) > SLOW_STATES:
                break
        return {"states": len(graph)}

    return timed(work)


def space_pm4py(name: str) -> dict[str, Any]:
    """Explore a net with pm4py's own semantics; stop after SLOW_STATES markings."""
    from pm4py.objects.petri_net import semantics
    from pm4py.objects.petri_net.obj import Marking, PetriNet
    from pm4py.objects.petri_net.utils import petri_utils

    net, model, first = SPACES[name](), PetriNet("net"), Marking()
    places = [PetriNet.Place(p) for p in net.places]
    for place, n in zip(places, net.initial, strict=True):
        model.places.add(place)
        if n:
            first[place] = n
    for t, transition in enumerate(net.transitions):
        node = PetriNet.Transition(transition, transition)
        model.transitions.add(node)
        for p, w in net.consume[t]:
            petri_utils.add_arc_from_to(places[p], node, model, weight=w)
        for p, w in net.produce[t]:
            petri_utils.add_arc_from_to(node, places[p], model, weight=w)

    def work() -> dict[str, Any]:
        seen, queue = {first}, [first]
        while queue and len(seen) <= SLOW_STATES:
            marking = queue.pop()
            for t in semantics.enabled_transitions(model, marking):
                after = semantics.weak_execute(t, marking)
                if after not in seen:
                    seen.add(after)
                    queue.append(after)
        return {"states": len(seen)}

    return timed(work)


def storm_model(net: Net, rates: dict[str, float]) -> Any:
    """Return a GSPN as a model of Storm."""
    from stormpy import gspn

    builder = getattr(gspn, "GspnBuilder", None) or gspn.GSPNBuilder  # renamed in stormpy 2
    builder = builder()
    places = [
        builder.add_place(CAPACITY, n, p) for p, n in zip(net.places, net.initial, strict=True)
    ]
    for t, name in enumerate(net.transitions):
        node = builder.add_timed_transition(0, rates.get(name, 1.0), 1, name)
        for p, w in net.consume[t]:
            builder.add_input_arc(places[p], node, w)
        for p, w in net.produce[t]:
            builder.add_output_arc(node, places[p], w)
    return builder.build_gspn()


def space_storm(name: str) -> dict[str, Any]:
    """Build Storm's explicit chain of the GSPN with unit rates."""
    import stormpy

    model = storm_jani(storm_model(SPACES[name](), {}))

    def work() -> dict[str, Any]:
        built = stormpy.build_model(model)
        return {"states": built.nr_states, "edges": built.nr_transitions}

    return timed(work)


def storm_jani(model: Any) -> Any:
    """Return Storm's symbolic description of a GSPN."""
    from stormpy import gspn

    if hasattr(gspn, "build_jani_model"):
        return gspn.build_jani_model(model)[0]
    return gspn.GSPNToJaniBuilder(model).build()


# Stochastic.


def firings_ours(name: str) -> dict[str, Any]:
    """Simulate Kanban-2 with ours."""
    import numpy as np

    from petrobot.coordinator.analysis.time.gspn import Gspn
    from petrobot.coordinator.analysis.time.simulate import simulate

    gspn = Gspn.of(kanban(2), KANBAN_RATES)

    def work() -> dict[str, Any]:
        seen = simulate(
            gspn,
            np.random.default_rng(1),
            replicas=2000,
            horizon=2500.0,
            firings=1_500_000,
        )
        return {"firings": seen.firings}

    return timed(work)


def firings_snakes(name: str) -> dict[str, Any]:
    """Fire transitions of Kanban-2 with SNAKES."""
    from snakes.nets import PetriNet, Place, Transition, Value, dot

    net, model = kanban(2), PetriNet("net")
    for p, place in enumerate(net.places):
        model.add_place(Place(place, [dot] * net.initial[p]))
    for t, transition in enumerate(net.transitions):
        model.add_transition(Transition(transition))
        for p, _ in net.consume[t]:
            model.add_input(net.places[p], transition, Value(dot))
        for p, _ in net.produce[t]:
            model.add_output(net.places[p], transition, Value(dot))

    def work() -> dict[str, Any]:
        fired = 0
        while fired < 3000:
            for node in model.transition():
                modes = node.modes()
                if modes:
                    node.fire(modes[0])
                    fired += 1
        return {"firings": fired}

    return timed(work)


def long_run_ours(name: str, engine: str) -> dict[str, Any]:
    """Build and solve the chain of a Kanban net: all throughputs and mean tokens. With engine
    `equal` only as precisely as Storm by default, with the largest error of all measures."""
    from petrobot.coordinator.analysis.time import linear
    from petrobot.coordinator.analysis.time.gspn import Chain, Gspn
    from petrobot.coordinator.analysis.time.markov import long_run

    gspn = Gspn.of(SPACES[name](), KANBAN_RATES)
    import scipy.sparse.linalg  # noqa: F401 - its import is not to be measured

    def solved(tolerance: float) -> dict[str, float]:
        with mock.patch.object(linear, "TOLERANCE", tolerance):
            run = long_run(Chain.of(gspn))
        tokens = {f"tokens in {place}": mean for place, mean in run.mean_tokens.items()}
        return {**run.throughput, **tokens, "states": run.chain.n}

    def work() -> dict[str, Any]:
        found = solved(EQUAL if engine == "equal" else linear.TOLERANCE)
        return {"states": int(found.pop("states")), "measures": len(found), "values": found}

    said = timed(work)
    exact, found = solved(linear.TOLERANCE), said.pop("values")
    error = max(abs(found[name] / exact[name] - 1.0) for name in found)
    return {**said, "precision": error if engine == "equal" else linear.TOLERANCE}


def long_run_storm(name: str) -> dict[str, Any]:
    """Compute with Storm the long-run share of time that a place is marked, at its default
    precision."""
    import stormpy

    jani = storm_jani(storm_model(SPACES[name](), KANBAN_RATES))

    def work() -> dict[str, Any]:
        (formula,) = stormpy.parse_properties("LRA=? [ pkan1 > 0 ]", jani)
        model = stormpy.build_model(jani, [formula])
        found = stormpy.model_checking(model, formula)
        value = getattr(found, "get_value", None) or found.at  # renamed in stormpy 2
        return {
            "states": model.nr_states,
            "precision": 1e-6,  # Storm's default (`storm --help`, option precision)
            "measures": 1,
            "value": value(model.initial_states[0]),
        }

    return timed(work)


def completion_ours(name: str, engine: str) -> dict[str, Any]:
    """Compute the mean time to completion and the reliability of the shipped catching task; `name`
    (stages-N) says how finely phases are refined."""
    from petrobot.coordinator.analysis.net.ordinary import OrdinaryView
    from petrobot.coordinator.analysis.time.completion import completion
    from petrobot.coordinator.analysis.time.gspn import Chain
    from petrobot.coordinator.analysis.time.stochastic import stochastic_view
    from petrobot.coordinator.task.file import load

    task = load(ROOT / "coordinator" / "tasks" / "catch_ball.toml")
    ordinary, stages = OrdinaryView(task), int(name.split("-")[1])
    view = stochastic_view(task, stages=stages, timer_stages=stages)
    start = time.process_time()
    chain = Chain.of(view.gspn)
    goal = chain.space.where(ordinary.is_final) & ~chain.vanishing
    _ = chain.graph.components, chain.graph.row, chain.probability
    built = time.process_time() - start
    said = timed(lambda: {"mean": completion(chain, goal).mean, "states": chain.n})
    return said | {"build_seconds": built}


MEASURES: dict[str, Callable[..., dict[str, Any]]] = {
    "space": space_ours,
    "verdicts": verdicts_ours,
    "space-snakes": space_snakes,
    "space-pm4py": space_pm4py,
    "space-storm": space_storm,
    "firings": firings_ours,
    "firings-snakes": firings_snakes,
    "long-run": long_run_ours,
    "long-run-storm": long_run_storm,
    "completion": completion_ours,
}


def one(measure: str, name: str, engine: str) -> None:
    """Run one measurement in this process and print it."""
    work = MEASURES[measure]
    said = work(name, engine) if engine else work(name)
    print(
        json.dumps(said | {"megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024})
    )


def measured(measure: str, name: str, engine: str = "") -> dict[str, Any] | None:
    """Run one measurement in a process of its own. Return None if its tool is not installed or it
    failed; both are printed."""
    tool = NEEDS.get(measure.rpartition("-")[2])
    if tool and find_spec(tool) is None:
        print(f"{measure} {name}: {tool} is not installed, skipped")
        return None
    command = [sys.executable, str(Path(__file__)), "--one", measure, name, engine]
    one_thread = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=ROOT, check=False, env=one_thread
    )
    if done.returncode:
        print(
            f"{measure} {name}: failed: "
            f"{done.stderr.strip().splitlines()[-1] if done.stderr else done.returncode}"
        )
        return None
    said: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return said


TOLD: list[str] = []
"""The lines printed so far, for --write."""


def tell(text: str) -> None:
    """Print a line and keep it."""
    print(text, flush=True)
    TOLD.append(text)


def line(what: str, said: dict[str, Any], unit: str, reference: float | None) -> None:
    """Return one line of the table; the ratio is to the reference rate."""
    rate = said[unit] / said["seconds"]
    ratio = f"{reference / rate:8.1f} x" if reference else " " * 10
    tell(
        f"  {what:22}{said[unit]:>11,} {unit:8}{said['seconds']:9.3f} s{rate:14,.0f} "
        f"/s{ratio}{said['megabytes']:8.0f} MB"
    )


def bench_spaces(names: tuple[str, ...]) -> None:
    """Measure state spaces of all nets with all tools, and our verdicts."""
    for name in names:
        net = SPACES[name]()
        size = f"{len(net.places)} places, {len(net.transitions)} transitions"
        tell(f"state space of {name}: {size} (ratio: how many times slower than numpy)")
        reference = None
        for what, measure, engine in (
            ("numpy", "space", "numpy"),
            ("auto", "space", "auto"),
            ("integers", "space", "integers"),
            ("Storm", "space-storm", ""),
            ("SNAKES", "space-snakes", ""),
            ("pm4py", "space-pm4py", ""),
        ):
            if (engine == "integers" and name not in QUICK) or (not engine and name in OTHERS_SKIP):
                continue
            said = measured(measure, name, engine)
            if said:
                reference = reference or said["states"] / said["seconds"]
                line(what, said, "states", reference)
        said = measured("verdicts", name) if name in JUDGED else None
        if said:
            both = said["explored_seconds"] + said["seconds"]
            tell(
                f"  all verdicts: explored in {said['explored_seconds']:.3f} s, explored and "
                f"judged in {both:.3f} s ({both / said['explored_seconds']:.2f} x), "
                f"{said['megabytes']:.0f} MB"
            )


def bench_stochastic(quick: bool) -> None:
    """Measure firings, long-run figures and completion."""
    tell("stochastic simulation of kanban-2 (ratio: how many times slower than numpy)")
    reference = None
    for what, measure in (("numpy", "firings"), ("SNAKES token game", "firings-snakes")):
        said = measured(measure, "kanban-2")
        if said:
            reference = reference or said["firings"] / said["seconds"]
            line(what, said, "firings", reference)
    for name in ("kanban-2",) if quick else ("kanban-2", "kanban-4"):
        tell(f"long run of {name}, build and solve")
        ours, storm = measured("long-run", name, "auto"), measured("long-run-storm", name)
        equal = measured("long-run", name, "equal")
        for what, said in (("all digits", ours), ("Storm's precision", equal), ("Storm", storm)):
            if said:
                line(what, said, "states", ours["states"] / ours["seconds"] if ours else None)
                tell(f"    precision {said['precision']:g}, {said['measures']} measures")
    for name in ("stages-4",) if quick else ("stages-4", "stages-8", "stages-16"):
        said = measured("completion", name, "auto")
        if said:
            tell(
                f"completion of the catching task, {name}: {said['states']:,} markings, "
                f"build {said['build_seconds']:.3f} s, "
                f"mean and probability {said['seconds']:.4f} s, {said['megabytes']:.0f} MB"
            )


def main() -> None:
    """Measure everything and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="small nets only")
    parser.add_argument(
        "--write", type=Path, metavar="FILE", help="write what is printed as a page, too"
    )
    parser.add_argument(
        "--one", nargs=3, metavar=("MEASURE", "NAME", "ENGINE"), help=argparse.SUPPRESS
    )
    options = parser.parse_args()
    if options.one:
        one(*options.one)
        return
    bench_spaces(QUICK if options.quick else tuple(SPACES))
    bench_stochastic(options.quick)
    if options.write:
        options.write.write_text(page(), encoding="utf-8")


def page() -> str:
    """Return the figures as a page of docs/."""
    versions = ", ".join(
        f"{name} {version(name)}" for name in ("numpy", *NEEDS.values()) if find_spec(name)
    )
    machine = f"{os.cpu_count()} cores, Python {sys.version.split()[0]}, {versions}"
    told = "\n".join(TOLD)
    return (
        "# Figures: the analysis compared with other tools\n\n"
        "The speed of the analysis, compared with other tools for Petri nets. Made by\n"
        "`python -m tools.bench.analysis --write docs/figures-analysis.md`, all tools in one run, "
        "each\nmeasurement in a process of its own. Seconds are CPU seconds without imports and "
        "compilation; MB is\nthe peak memory of the process. Ratios hold on other machines, "
        "seconds do not. SNAKES and pm4py are\n"
        f"stopped after {SLOW_STATES:,} markings: compare their rate.\n\n"
        f"{fill(f'Machine: {machine}.', 100)}\n\n"
        f"```\n{told}\n```\n"
    )


if __name__ == "__main__":
    main()
