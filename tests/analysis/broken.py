"""Deliberately broken variants of a task: mistakes of designers that the analysis must find.

`python -m tests.analysis.broken FOLDER TASK...` draws the findings for docs/.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from msgspec.structs import replace

from petrobot.coordinator.analysis.execution.graph import STEPS
from petrobot.coordinator.analysis.net.space import SearchLimits
from petrobot.coordinator.analysis.report import Analysis, analyse
from petrobot.coordinator.cli.analyse import picture, refused
from petrobot.coordinator.task import End, Kind, Task, Transition
from petrobot.coordinator.task.conditions import parse
from petrobot.coordinator.task.file import load
from tests.engine.conftest import make_task

TASKS = Path(__file__).parents[2] / "coordinator" / "tasks"
LIMITS = SearchLimits(states=20_000)


def _with(task: Task, transition: Transition) -> Task:
    return replace(task, transitions={**task.transitions, transition.name: transition})


def error_exits(task: Task) -> list[Transition]:
    """Return the transitions that take a run which ended with ERROR, in the order of the file."""
    return [
        t
        for t in task.transitions.values()
        if any(a.end is End.ERROR for a in t.inputs) and t.outputs
    ]


def missing_recovery(task: Task) -> Task:
    """The first error exit returns nothing: the failed run's resources are lost."""
    return _with(task, replace(error_exits(task)[0], outputs=()))


def double_resource(task: Task) -> Task:
    """Every resource exists twice, so two runs may use one device at a time."""
    places = {
        name: replace(p, tokens=2, capacity=None)
        if p.kind is Kind.RESOURCE and p.tokens == 1
        else p
        for name, p in task.places.items()
    }
    return replace(task, places=places)


def leaking_token(task: Task) -> Task:
    """The first error exit returns a resource twice: each error adds a token."""
    exit_ = next(t for t in error_exits(task) if _resource(task, t))
    resource = _resource(task, exit_)
    assert resource is not None
    outputs = tuple(replace(o, weight=2) if o.place == resource else o for o in exit_.outputs)
    place = replace(task.places[resource], capacity=None)
    return replace(
        _with(task, replace(exit_, outputs=outputs)), places={**task.places, resource: place}
    )


def _resource(task: Task, t: Transition) -> str | None:
    return next((o.place for o in t.outputs if task.places[o.place].kind is Kind.RESOURCE), None)


VARIANTS: dict[str, Callable[[Task], Task]] = {
    "missing_recovery": missing_recovery,
    "double_resource": double_resource,
    "leaking_token": leaking_token,
}


def with_button(task: Task, broken: str) -> Task:
    """Add a branch that blinks whenever a button is pressed; its error goes to a place."""
    net = {
        "pressed": {"in": "idle", "out": "blink", "event": "button"},
        "blinked": {"in": "blink:normal", "out": "idle"},
        "dark": {"in": "blink:error", "out": broken},
    }
    loop = make_task("blink! idle=1", net, "button+")
    idle, blink = loop.places["idle"], replace(loop.places["blink"], listen=True)
    idle = replace(idle, kind=Kind.PLAIN, listen=True)
    return replace(
        task,
        places={**task.places, "idle": idle, "blink": blink},
        transitions={**task.transitions, **loop.transitions},
        primitive_tasks={**task.primitive_tasks, **loop.primitive_tasks},
        events={**task.events, **loop.events},
    )


def with_stop(task: Task, *, reset: bool = False) -> Task:
    """Add a stop button, which ends the task with `final_error` where nothing is active. A second
    button may `reset` it before."""
    net = {"halt": {"in": "running", "event": "stop", "out": "halted"}}
    if reset:
        net["release"] = {"in": "halted", "event": "again", "out": "running"}
    branch = make_task("running=1 halted", net, "stop+ again+" if reset else "stop+")
    ends = "halted == 1" if task.final_error is None else f"halted == 1 or {task.final_error}"
    return replace(
        task,
        places={**task.places, **branch.places},
        transitions={**task.transitions, **branch.transitions},
        events={**task.events, **branch.events},
        final_error=parse(ends),
    )


def damaged(task: Task) -> Iterator[tuple[str, Task]]:
    """Yield the task with each single mistake: an arc lost, doubled, redirected or added, or tokens
    changed."""
    for t in task.transitions.values():
        for i, o in enumerate(t.outputs):
            others = (*t.outputs[:i], *t.outputs[i + 1 :])
            yield f"{t.name} no longer gives {o.place}", _with(task, replace(t, outputs=others))
            yield (
                f"{t.name} gives {o.place} twice",
                _with(task, replace(t, outputs=(*others, replace(o, weight=2)))),
            )
            for p in task.places.values():
                if p.kind is task.places[o.place].kind and p.name not in {
                    x.place for x in t.outputs
                }:
                    outputs = (*others, replace(o, place=p.name))
                    yield (
                        f"{t.name} gives {p.name} for {o.place}",
                        _with(task, replace(t, outputs=outputs)),
                    )
        for i, a in enumerate(t.inputs):
            rest = (*t.inputs[:i], *t.inputs[i + 1 :])
            yield f"{t.name} no longer takes {a.place}", _with(task, replace(t, inputs=rest))
        if t.inhibitors:
            yield f"{t.name} is no longer barred", _with(task, replace(t, inhibitors=()))
    for p in task.places.values():
        if p.kind is not Kind.ACTION:
            more = replace(p, tokens=p.tokens + 1, capacity=None)
            yield f"{p.name} holds one more", replace(task, places={**task.places, p.name: more})


def judged(task: Task, steps: int = STEPS) -> Analysis:
    """Return the analysis of a variant; of an unbounded one it ends early."""
    return analyse(task, limits=LIMITS, steps=steps)


def main(folder: Path, names: list[str]) -> None:
    """Draw the first refused verdict of each variant."""
    for name in names:
        for kind, break_it in VARIANTS.items():
            task = break_it(load(TASKS / f"{name}.toml"))
            verdict, why = next(iter(refused(judged(task))))
            assert why.witness is not None
            path = folder / f"{name}-{kind}.svg"
            path.write_text(picture(task, verdict, why.reason, why.witness), encoding="utf-8")
            print(path, verdict, why.reason)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
