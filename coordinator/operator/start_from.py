"""Start a simulated run from a point of a recorded one: the state after one of its records, and
what happens to the actions active at that point.

A marking describes the state of the task, not that of the world. The laboratory of the new run is
therefore prepared as for any run, and an action active at that point starts again (the default), or
counts as ended if the operator gives its result. Runs that had ended and whose token still waited
stay ended, with their status and cause. Variables and latched events keep their values; timers
start again; the operator's settings (pause, breakpoints, choices) are not kept. Record 0 is the
start of the run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from msgspec import Struct, field

from petrobot.coordinator.engine import (
    Engine,
    Mode,
    Phase,
    Point,
    Run,
    Standing,
    State,
    point_from_plain,
    to_plain,
)
from petrobot.coordinator.launch import Setting
from petrobot.coordinator.operator.history import plant_of, task_of
from petrobot.coordinator.run.folder import still_there
from petrobot.coordinator.run.interfaces import FirstAlternative, Observer
from petrobot.coordinator.run.journal import Journal, JournalError, read_journal
from petrobot.coordinator.run.recording import STIMULUS, RecordedStep, replay
from petrobot.coordinator.task import Kind, Status, Task
from petrobot.services.comm.location_file import Directory, parse
from petrobot.services.host.toml_text import InputError

AGAIN = "again"
"""An active run starts again."""
ENDS = (AGAIN, *(status.value for status in Status))
"""What can happen to an active run; an end may be followed by a colon and a cause."""


HEADER = ("mission", "mode", "task", "services", "services_path", "seed", "runs", "parameters")
"""Keys of a journal's header that are needed to replay its run."""


class Recorded(Struct, frozen=True):
    """A recorded mission run with its task, cell and engine."""

    journal: Journal
    task: Task
    directory: Directory
    engine: Engine

    @property
    def plant(self) -> str:
        """Where it took place."""
        return plant_of(self.journal.header, self.directory)

    def steps(self) -> Iterator[RecordedStep]:
        """Replay every stimulus."""
        return replay(self.journal, self.engine)


def read_recorded(path: Path) -> Recorded:
    """Read a journal, and build task, cell and engine of its run from the texts in its header.

    Raises JournalError (also for a file that is not the journal of a mission run), TaskFileError,
    DirectoryError, OSError.
    """
    journal = read_journal(path)
    then = journal.header
    for key in HEADER:
        if key not in then:
            raise JournalError(
                f"{path}: its header has no {key!r}; it is not the journal of a mission run"
            )
    task = task_of(journal)
    directory = parse(then["services"], still_there(Path(then["services_path"])))
    devices = {a.name: a.device for a in directory.actions.values() if a.device}
    return Recorded(journal, task, directory, Engine(task, devices))


class DepartureError(InputError, ValueError):
    """No run can start there: which record or word is wrong, and what is possible."""


class Departure(Struct, frozen=True):
    """A point of a recorded run; `point` is None at its beginning."""

    run: str
    record: int
    time: float = 0.0
    """Time on the recorded run's clock (s)."""
    going: Mapping[str, str] = field(default_factory=dict)
    """What happens to the runs active at that point, by place."""
    point: Point | None = None

    def plain(self) -> dict[str, Any]:
        """Return the data for the header of the new run's journal."""
        plain = {
            "run": self.run,
            "record": self.record,
            "time": self.time,
            "going": dict(self.going),
        }
        return plain if self.point is None else {**plain, "point": to_plain(self.point)}


def departure(
    journal: Journal, engine: Engine, run: str, record: int, going: Mapping[str, str] | str
) -> Departure:
    """Return the state after a record (of those between two stimuli, the earlier one) as a point to
    start from.

    `going` is one word for all active runs, or words by place; runs in places that are not named
    start again. Raises DepartureError, and what `replay` raises if the journal cannot be replayed.
    """
    numbers = [r.number for r in journal.records if r.kind == STIMULUS]
    last = numbers[-1] if numbers else 0
    if not 0 <= record <= last:
        raise DepartureError(f"{run} has records 0 (its beginning) to {last}, but not {record}")
    state, time = engine.initial(), 0.0
    for step in replay(journal, engine):
        if step.number > record:
            break
        state, time = step.state, step.time
    live = {r.place for r in state.runs() if r.phase is not Phase.DONE}
    if state.mode is Mode.FRESH:
        return Departure(run, record, time, _words(live, going))
    words = _words(live, going)
    return Departure(run, record, time, words, point_of(engine, state, words))


def departed(then: Mapping[str, Any]) -> Point | None:
    """Return the point at which a run started, from its journal's header; None if it started at the
    beginning of the task."""
    plain = then.get("from", {}).get("point")
    return None if plain is None else point_from_plain(plain)


def departing(
    journal: Journal,
    task: Task,
    engine: Engine,
    departure: Departure,
    seed: int | None = None,
    parameters: Mapping[str, Any] | None = None,
) -> Setting:
    """Return the setting of the new run: that of the recorded one, except for a given `seed` and
    `parameters`.

    The selector has its state of that point; what it learns later is not saved. Raises ValueError,
    EstimatesError.
    """
    then = journal.header
    # Here, because it imports numpy: `petrobot log` reads a run and starts none.
    from petrobot.coordinator.learning.session import fixed_by_user, session_of

    session = session_of(task, then)
    if session is not None:
        _bring(session.selector, journal, engine, departure.record)
    selector = FirstAlternative(fixed_by_user(then)) if session is None else session.selector
    given = {**then["parameters"], **(parameters or {})}
    return Setting(
        task, given, then["runs"], then["seed"] if seed is None else seed, selector, departure.point
    )


def _bring(selector: Observer, journal: Journal, engine: Engine, record: int) -> None:
    for step in replay(journal, engine):
        if step.number > record:
            return
        selector.stimulus(step.time, step.stimulus)
        for instruction in step.instructions:
            selector.instruction(step.time, instruction)
        selector.settled(step.time, step.state)


def point_of(engine: Engine, state: State, words: Mapping[str, str]) -> Point:
    """Return a state as a point to start from; `words` give what happens to the active runs, by
    place."""
    task, places = engine.compiled.task, engine.compiled.net.places
    tokens = {place: n for place, n in zip(places, state.marking, strict=True) if n}
    marking = {
        place: n for place, n in tokens.items() if task.places[place].kind is not Kind.ACTION
    }
    runs = sorted(state.runs(), key=lambda r: (r.phase is not Phase.DONE, r.ended, r.order))
    over = [Standing(r.place, r.status, r.cause, r.action) for r in runs if r.phase is Phase.DONE]
    live = [_standing(r, words.get(r.place, AGAIN)) for r in runs if r.phase is not Phase.DONE]
    ended = [s for s in live if s.status is not None]
    verdicts: dict[str, Any] = {}
    for s in ended:
        verdicts |= {f"{s.place}.status": str(s.status), f"{s.place}.reason": s.cause}
    # An aborted run leaves tokens without runs: they start again, too.
    held = {place: sum(r.place == place for r in runs) for place in tokens}
    bare = [
        Standing(p)
        for p, n in tokens.items()
        if task.places[p].kind is Kind.ACTION
        for _ in range(n - held[p])
    ]
    standing = (*over, *ended, *(s for s in live if s.status is None), *bare)
    return Point(marking, standing, {**state.variables, **verdicts}, state.flags)


def _standing(run: Run, word: str) -> Standing:
    end, _, cause = word.partition(":")
    return (
        Standing(run.place) if end == AGAIN else Standing(run.place, Status(end), cause, run.action)
    )


def _words(live: set[str], going: Mapping[str, str] | str) -> dict[str, str]:
    given = dict.fromkeys(sorted(live), going) if isinstance(going, str) else dict(going)
    for place, word in given.items():
        if place not in live:
            there = f"active: {', '.join(sorted(live))}" if live else "no run was active"
            raise DepartureError(f"no run was active in {place!r} at that record; {there}")
        _check(word)
    if isinstance(going, str):
        _check(going)
    return {place: given.get(place, AGAIN) for place in sorted(live)}


def _check(word: str) -> None:
    end, colon, _ = word.partition(":")
    if end not in ENDS or (end == AGAIN and colon):
        raise DepartureError(
            f"expected `{AGAIN}` or a result ({', '.join(ENDS[1:])})[:CAUSE] for an active run, "
            f"got {word!r}"
        )
