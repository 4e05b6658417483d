"""A mission run from beginning to end: prepare the cell, execute the task, ask for the score. A
sans-I/O machine like its parts."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.engine import Mode, State
from petrobot.coordinator.engine.instructions import (
    Corrected,
    Fired,
    Instruction,
    Marked,
    Report,
    RunRecorded,
    Severity,
)
from petrobot.coordinator.engine.stimuli import Begin, Point, Stimulus
from petrobot.coordinator.run.executor import Executor
from petrobot.coordinator.run.recording import NODE, PREPARED, SCORED, STAGE, RecordedStep
from petrobot.coordinator.task import Status
from petrobot.coordinator.task.net import Marking
from petrobot.services.comm.calls.caller import Caller, Notice, PeerLost
from petrobot.services.comm.calls.events import STOP_EVENT, RunVerdict
from petrobot.services.comm.location_file import MEMORY, Directory, DirectoryError
from petrobot.services.comm.protocol.messages import (
    SEED,
    Call,
    Command,
    Event,
    Executed,
    Feedback,
    Outcome,
    Welcome,
    split_boot,
)
from petrobot.services.host.toml_text import InputError

_log = logging.getLogger(__package__)
MOST_TOLD = 20_000
"""Most entries of cycles, and of their open runs, that a score receives: 3,333 cycles without open
runs. A message carries little more (docs/protocol.md)."""
KEPT = 5_000
"""Least number of the newest cycles and runs that are kept, for a score and for verdicts that come
late. A mission run may last for months."""
SERVICE_DEADLINE = 20.0
BAD_VALUE = "bad_value"
"""Key of the engine's report of a result that did not give a value, or one that does not fit."""
UNSCORED = "unscored"
"""Key of a result without its score: why there is none."""
VERDICTS = "verdicts"
"""Key of a score under which it judges runs that ended provisionally: {run: {status, cause,
text}}."""


class Stage(Enum):
    """Stage of a mission run."""

    CONNECTING = "connecting"
    PREPARING = "preparing"
    RUNNING = "running"
    SCORING = "scoring"
    OVER = "over"


class MissionError(InputError):
    """A mission run could not be prepared or scored; the text says what failed, and why."""

    def __init__(self, text: str, *, bad_input: bool = False) -> None:
        super().__init__(text)
        self.bad_input = bad_input
        self.exit_code = 2 if bad_input else 1


class Cycle(Struct):
    """One token taken out of the runs place, and the runs that followed from it."""

    number: int
    begun: float
    ended: float | None = None
    ends: dict[str, tuple[Status, str, str]] = field(default_factory=dict)
    """By run, in the order in which they ended: status, cause and text."""
    forgotten: tuple[Status, str, str] = (Status.SUCCESS, "", "")
    """The worst of the older runs, of which nothing else is kept."""
    goals: int = 0
    """Firings of goal transitions."""
    errors: int = 0
    """Runs that ended in ERROR and were not cancelled."""
    last: str = ""
    """The run of its last end or verdict other than SUCCESS."""

    @property
    def lost(self) -> int:
        """Number of its errors if it met no goal, else 0."""
        return 0 if self.goals else self.errors

    def count(self, run: str, status: Status | None, cause: str, text: str) -> None:
        """Add a run, or the verdict on an earlier one."""
        if status is not None:
            self.ends[run] = (status, cause, text)
            if status is not Status.SUCCESS:
                self.last = run
            elif self.last == run:  # a verdict took it away
                bad = (name for name in reversed(self.ends) if self.ends[name][0] is not status)
                self.last = next(bad, "")
        if len(self.ends) >= 2 * KEPT:
            old = [self.ends.pop(run) for run in list(self.ends)[:KEPT]]
            self.forgotten = _worst([self.forgotten, *old])

    @property
    def worst(self) -> tuple[Status, str, str]:
        """Return the run with the worst status, the first one at a tie: status, cause and text."""
        worst = _worst([self.forgotten, *self.ends.values()])
        return (Status.SUCCESS, "", "") if worst[0] is Status.SUCCESS else worst

    @property
    def status(self) -> Status:
        """The worst status of its runs."""
        return self.worst[0]

    def plain(self, now: float) -> dict[str, Any]:
        """Return plain data; times become ages (s), since only durations cross the wire."""
        ended = now if self.ended is None else self.ended
        ages = {"begun_ago": now - self.begun, "ended_ago": now - ended}
        status, cause, text = self.worst
        return {"n": self.number, **ages, "status": status.value, "cause": cause, "text": text}


def _worst(ends: list[tuple[Status, str, str]]) -> tuple[Status, str, str]:
    return max(ends, key=lambda end: [Status.SUCCESS, Status.FAILURE, Status.ERROR].index(end[0]))


def _count(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"


def _forget_oldest(entries: list[Any]) -> list[Any]:
    oldest = entries[:KEPT] if len(entries) >= 2 * KEPT else []
    del entries[: len(oldest)]
    return oldest


class MissionTally(Struct):
    """An observer that counts what the result needs: firings, runs, their errors and missing
    values. It keeps the newest cycles and runs. Errors of the net are logged at once: a task that
    is stuck may never have a result."""

    runs_place: int | None
    goal_transitions: frozenset[str] = frozenset()
    goals: int = 0
    """Firings of goal transitions."""
    added: int = 0
    """Tokens that the operator put into the runs place, less those taken out."""
    firings: int = 0
    ended: int = 0
    """Runs that ended, also by preemption."""
    preempted: int = 0
    failed: Counter[str] = field(default_factory=Counter)
    """Runs that ended in ERROR, by primitive task and cause."""
    examples: dict[str, RunRecorded] = field(default_factory=dict)
    """By the same key the last of them, in the order of their ends."""
    failure: RunRecorded | None = None
    """The last run that ended in FAILURE."""
    missing: int = 0
    """Values that a result lacked."""
    first_missing: str = ""
    cycles: list[Cycle] = field(default_factory=list)
    older_lost: int = 0
    """Errors in forgotten cycles that met no goal."""
    runs: list[RunRecorded] = field(default_factory=list)

    def instruction(self, now: float, instruction: Instruction) -> None:
        """Count."""
        if isinstance(instruction, Fired):
            self.firings += 1
            if instruction.transition in self.goal_transitions:
                self.goals += 1
                if self.cycles:
                    self.cycles[-1].goals += 1
            self._cycle(now, instruction.before, instruction.after)
        elif isinstance(instruction, Marked) and instruction.place and self.runs_place is not None:
            before, after = instruction.before, instruction.after
            self.added += after[self.runs_place] - before[self.runs_place]
        elif isinstance(instruction, RunRecorded):
            _forget_oldest(self.runs)
            self.runs.append(instruction)
            failed = self._judge(instruction, 1)
            self.ended += 1
            self.preempted += instruction.cancelled
            if self.cycles:
                self.cycles[-1].errors += failed
                self.cycles[-1].count(
                    instruction.run, instruction.status, instruction.cause, instruction.text
                )
        elif isinstance(instruction, Corrected):
            self._correct(instruction)
        elif isinstance(instruction, Report):
            if instruction.key == BAD_VALUE:
                self.missing += 1
                self.first_missing = self.first_missing or instruction.text
            if instruction.severity is Severity.ERROR:
                _log.error("%.3f s: %s", now, instruction.text)

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """Nothing to count."""

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """Nothing to count."""

    def settled(self, now: float, state: State) -> None:
        """Nothing to count."""

    @property
    def begun(self) -> int:
        """How many cycles have begun."""
        return self.cycles[-1].number if self.cycles else 0

    def last_errors(self, directory: Directory) -> list[dict[str, Any]]:
        """Return for each primitive task and cause the last run that ended so, in order: which
        action, on which node, and why."""
        return [
            _row(record, directory)
            for key, record in self.examples.items()
            if self.failed[key] > 0  # a verdict may have taken the last error of a cause away
        ]

    def missed(self, directory: Directory) -> list[dict[str, Any]]:
        """Return for each primitive task and cause the last run that cost a goal, and how many
        `goals`: the last end or verdict other than SUCCESS of each cycle without a goal. Empty
        where that is not known: if cycles overlap, or some were forgotten."""
        lost, found = [cycle for cycle in self.cycles if not cycle.goals], dict[str, Any]()
        records = {record.run: record for record in self.runs}
        for cycle in lost if len(lost) == self.begun - self.goals else ():
            if (record := records.get(cycle.last)) is not None:
                key = f"{record.primitive_task}: {record.cause}"
                count = found.pop(key, {}).get("goals", 0) + 1  # a later one goes to the end
                found[key] = {**_row(record, directory), "goals": count}
        return list(found.values())

    def happened(self, recovered: bool, missed: bool = False) -> str:
        """Return what happened on the way, in words: number of runs, errors by primitive task and
        cause, and values that a result lacked. `recovered`: the task reached its end as designed;
        `missed`: it met fewer goals than it was asked for."""
        failed = +self.failed  # a verdict may have taken the last error of a cause away
        cut = f", {self.preempted} of them preempted" if self.preempted else ""
        parts = [_count(self.ended, "run") + cut]
        if failed:
            causes = ", ".join(f"{name} ({n})" if n > 1 else name for name, n in failed.items())
            told = ", all recovered" if recovered else ""
            lost = self.older_lost + sum(cycle.lost for cycle in self.cycles)
            if not self.cycles:  # a task without trials: its one goal was missed
                lost = failed.total()
            if told and missed and lost:
                told += f", {lost} of them where a goal was missed"
            parts.append(f"{_count(failed.total(), 'error')}{told} [{causes}]")
        if self.missing:
            parts.append(f"{_count(self.missing, 'value')} missing [{self.first_missing}]")
        return "; ".join(parts)

    def _judge(self, record: RunRecorded, count: int) -> int:
        """Add a run (`count` = 1), or take it away (-1); return the change of the errors."""
        if record.status is Status.ERROR and not record.cancelled:
            key = f"{record.primitive_task}: {record.cause or 'no cause'}"
            self.failed[key] += count
            if count > 0:
                self.examples.pop(key, None)  # a later one goes to the end
                self.examples[key] = record
            return count
        if record.status is Status.FAILURE and not record.cancelled:
            self.failure = record
        return 0

    def _correct(self, corrected: Corrected) -> None:
        run, said = corrected.run, (corrected.status, corrected.cause, corrected.text)
        change = 0
        for n in reversed(range(len(self.runs))):
            if self.runs[n].run == run:
                change = self._judge(self.runs[n], -1)
                self.runs[n] = replace(
                    self.runs[n], status=said[0], cause=said[1], text=said[2], deferred=False
                )
                change += self._judge(self.runs[n], 1)
                break
        for cycle in reversed(self.cycles):
            if run in cycle.ends:
                cycle.count(run, *said)
                cycle.errors += change
                break

    def _cycle(self, now: float, before: Marking, after: Marking) -> None:
        if self.runs_place is None or after[self.runs_place] >= before[self.runs_place]:
            return
        if self.cycles:
            self.cycles[-1].ended = now
        self.older_lost += sum(cycle.lost for cycle in _forget_oldest(self.cycles))
        self.cycles.append(Cycle(self.begun + 1, now))


def _row(record: RunRecorded, directory: Directory) -> dict[str, Any]:
    """Return which action a run was, on which node, and why it ended so."""
    return {
        "run": record.run,
        "primitive_task": record.primitive_task,
        "action": record.action,
        "node": _node_of(record.action, directory),
        "cause": record.cause,
        "text": record.text,
    }


def _node_of(action: str, directory: Directory) -> str:
    """Return the node of an action; empty for a run without one."""
    try:
        return directory.where(action)
    except DirectoryError:
        return ""


class Mission:
    """One mission run over its executor's callers."""

    def __init__(self, executor: Executor, parameters: Mapping[str, Any], runs: int) -> None:
        self.executor = executor
        self.parameters = dict(parameters)
        self.runs = runs
        self.stage = Stage.CONNECTING
        self.score: Mapping[str, Any] = {}
        self.begun = self.ended = 0.0
        self.point: Point | None = None
        """Where the task begins, if not at its initial marking; only for simulated runs, because a
        real world cannot be placed at will."""
        self.lost: dict[str, str] = {}
        """Nodes that are not connected, with the reason."""
        self.remarks: dict[str, str] = {}
        """Remarks of the shell for the result, for example that the host was too busy."""
        self._early: list[tuple[str, Notice]] = []
        self._boots: dict[str, str] = {}
        """By node: its process when it welcomed us last."""
        self._resumed = False
        """Whether an earlier process may have asked for the preparation or the score."""
        task = executor.task.flat
        index = task.net.place_index.get(task.runs_place) if task.runs_place else None
        self.tally = MissionTally(index, frozenset(task.goal_transitions))
        executor.observers.append(self.tally)

    @property
    def callers(self) -> Mapping[str, Caller]:
        """One caller for each node."""
        return self.executor.callers

    def start(self, now: float) -> None:
        """Start, with all nodes connected: prepare the cell, or begin at once if there is nothing
        to prepare."""
        asked = {**self.parameters, "seed": self.executor.seed, "runs": self.runs}
        if not self._ask(now, "prepare", self.executor.task.prepare, asked):
            self._begin(now)
        else:
            self.stage = Stage.PREPARING

    def replay(self, now: float, step: RecordedStep) -> None:
        """Replay a step that another process recorded at `now` (on this process's clock)."""
        if isinstance(step.stimulus, Begin):
            self.begun = now
        self.executor.replay(now, step)
        self._boots.update(step.boots)
        if self.executor.finished is not None and not self.ended:
            self.ended = now

    def resume(self, now: float, stages: Mapping[str, Mapping[str, Any]]) -> None:
        """Continue after the last replayed step; `stages` are those that the journal records as
        completed."""
        self._resumed = True
        if SCORED in stages:
            self.score, self.stage = stages[SCORED], Stage.OVER
        elif self.executor.finished is not None:
            self._finish(now, self.ended)
        elif self.executor.state.mode is not Mode.FRESH:
            self.stage = Stage.RUNNING
            self.executor.subscribe(now, fresh=False)
            self.executor.adopt(now)
            self.advance(now)
        elif PREPARED in stages:
            self._begin(now)
        else:
            self.start(now)
        early, self._early = self._early, []
        for node, notice in early:
            self.take(now, node, [notice])

    def take(self, now: float, node: str, notices: Sequence[Notice]) -> None:
        """Handle what a node's caller noticed. Notices wait until every node is connected: a
        mission never starts with a part of its nodes."""
        self._refuse_to_begin(node, notices)
        self._note_links(now, node, notices)
        if self.stage is Stage.CONNECTING:
            self._early.extend(
                (node, notice) for notice in notices if not isinstance(notice, Welcome | PeerLost)
            )
            notices = [notice for notice in notices if isinstance(notice, Welcome | PeerLost)]
        own = [n for n in notices if isinstance(n, Outcome) and self._is_own(n)]
        for notice in own:
            self._answered(now, node, notice)
        self.executor.take(now, node, [n for n in notices if n not in own])
        self.advance(now)

    def advance(self, now: float) -> None:
        """Do what is due."""
        if self.stage is Stage.RUNNING:
            self.executor.advance(now)
            if self.executor.over:
                self._finish(now, now)

    def synced(self, now: float) -> None:
        """Continue when a sync in the background has ended."""
        self.executor.synced(now)
        self.advance(now)

    def due(self) -> float | None:
        """Return when `advance` is needed next."""
        return self.executor.due() if self.stage is Stage.RUNNING else None

    def result(self, mode: str, wall_s: float) -> dict[str, Any]:
        """Return the result as the command line writes it; the keys of the score stand beside the
        general ones. `last_errors` says why actions ended in ERROR, also those that the task
        recovered from, and `missed_goals` which ends and verdicts cost goals. `last_failure` is set
        if the task ended in ERROR and no action did."""
        finished = self.executor.finished
        failed = finished is None or finished.status is Status.ERROR
        errors = self.tally.last_errors(self.executor.directory)
        failure = self.tally.failure if failed and not errors else None
        has_goal, met = bool(self.tally.goal_transitions), self.tally.goals
        wanted = self.runs + self.tally.added
        missed = self.tally.missed(self.executor.directory) if has_goal and met < wanted else []
        # A run may meet several goals: "4 of 2" would be no share.
        within = f"of {wanted}" if met <= wanted else f"in {wanted} run{'s' * (wanted != 1)}"
        general = {
            "task": self.executor.task.name,
            "mode": mode,
            **self.parameters,
            "seed": self.executor.seed,
            "runs": self.runs,
            "status": finished.status.value if finished else Status.ERROR.value,
            "reason": finished.told if finished else "not finished",
            **({"goals": f"{met} {within}"} if has_goal else {}),
            "happened": self.tally.happened(not failed, has_goal and met < wanted),
            **({"last_errors": errors} if errors else {}),
            **({"missed_goals": missed} if missed else {}),
            **({"last_failure": _row(failure, self.executor.directory)} if failure else {}),
            **self.remarks,
        }
        durations = {
            "wall_s": round(wall_s, 3),
            "sim_s": round(self.ended - self.begun, 6),
            "firings": self.tally.firings,
        }
        return {**general, **self.score, **durations}

    # --- stages -------------------------------------------------------------------------------

    def _begin(self, now: float) -> None:
        self.stage, self.begun = Stage.RUNNING, now
        self.executor.subscribe(now, fresh=True)
        self.executor.stimulate(now, Begin(self.parameters, point=self.point))

    def _finish(self, now: float, ended: float) -> None:
        self.ended = ended
        if self.tally.cycles:
            self.tally.cycles[-1].ended = ended
        cycles = self._cycles_to_score(now)
        asked = self._ask(now, "score", self.executor.task.score, {"cycles": cycles})
        self.stage = Stage.SCORING if asked else Stage.OVER

    def _cycles_to_score(self, now: float) -> list[dict[str, Any]]:
        """Return the cycles for the score, of a long mission run the newest that one call
        carries."""
        cycles: list[dict[str, Any]] = []
        left = MOST_TOLD
        for cycle in reversed(self.tally.cycles):
            told = cycle.plain(now) | self._provisional(cycle)
            left -= len(told) + sum(map(len, told.get("provisional", ())))
            if left < 0:
                self.remarks["scored"] = (
                    f"the newest {len(cycles):,} of {self.tally.begun:,} cycles: one call "
                    "carries no more"
                )
                break
            cycles.append(told)
        return cycles[::-1]

    def _provisional(self, cycle: Cycle) -> dict[str, Any]:
        """Return what the score must know of a cycle's runs that have no verdict yet."""
        open_, call_id = self.executor.state.deferred, self.executor.dispatch.call_id
        runs = [
            {
                "run": call_id(run),
                "place": open_[run].place,
                "action": open_[run].action,
                "status": open_[run].status.value,
            }
            for run in cycle.ends
            if run in open_
        ]
        return {"provisional": runs} if runs else {}

    def _ask(self, now: float, what: str, service: str, arguments: Mapping[str, Any]) -> bool:
        """Call a service of the task. Return False if the task names none, or no node offers it (a
        real cell has no referee)."""
        if not service or service not in self.executor.directory.services:
            return False
        caller = self.callers[self.executor.directory.where(service)]
        identity = f"{self.executor.mission}/{what}"
        seed = self.executor.seed
        caller.call(
            now,
            Call(identity, service, arguments, SERVICE_DEADLINE, seed=seed, again=self._resumed),
        )
        return True

    def _is_own(self, outcome: Outcome) -> bool:
        return outcome.id in (f"{self.executor.mission}/prepare", f"{self.executor.mission}/score")

    def _answered(self, now: float, node: str, outcome: Outcome) -> None:
        if outcome.status != Status.SUCCESS:
            what = outcome.id.rpartition("/")[2]
            lost = outcome.executed == Executed.UNKNOWN
            why = f"; `petrobot log {node}` may say why" if lost else ""
            raise MissionError(
                f"{what} on {node}: {outcome.text or outcome.cause}{why}",
                bad_input=outcome.cause == "bad_arguments",
            )
        store, stage = self.executor.store, self.stage
        score = {key: value for key, value in outcome.values.items() if key != VERDICTS}
        if stage is Stage.PREPARING:
            store.record(STAGE, {"stage": PREPARED, "values": {}})
        elif stage is Stage.SCORING:
            self.executor.stimulate(
                now, *map(self.executor.verdict, _verdicts(outcome.values.get(VERDICTS, {})))
            )
            store.record(STAGE, {"stage": SCORED, "values": dict(score)})

        def safe(now: float) -> None:
            if stage is self.stage is Stage.PREPARING:
                self._begin(now)
            elif stage is self.stage is Stage.SCORING:
                self.score, self.stage = score, Stage.OVER
            self.callers[node].acknowledge(now, outcome.id)

        self.executor.when_safe(now, safe)

    def _refuse_to_begin(self, node: str, notices: Sequence[Notice]) -> None:
        """Raise MissionError if the task has not begun, and a node reports an emergency stop, or
        that it has cleared one since it was connected."""
        if self.executor.state.mode is not Mode.FRESH:
            return  # then the executor aborts
        for notice in notices:
            if (isinstance(notice, Event) and notice.name == STOP_EVENT) or (
                isinstance(notice, Welcome)
                and split_boot(notice.boot)[1] != self.callers[node].stops
            ):
                raise MissionError(
                    f"emergency stop, as {node} reports: the task was not begun; when the cell is "
                    "safe, clear the stop and start the task again"
                )

    def _note_links(self, now: float, node: str, notices: Sequence[Notice]) -> None:
        for notice in notices:
            if isinstance(notice, PeerLost):
                self.lost[node] = notice.reason
            elif isinstance(notice, Welcome):
                self.lost.pop(node, None)
                process = split_boot(notice.boot)[0]
                self.executor.store.record(NODE, {"node": node, "boot": process})
                self._note_lost_memory(now, node, process)
                self._boots[node] = process
                self._send_seed(now, node)

    def _note_lost_memory(self, now: float, node: str, process: str) -> None:
        """Note in the log and the result that the node of the global memory was started again in
        the middle of the run: its process alone kept the memory."""
        memory = self.executor.directory.services.get(MEMORY)
        again = self._boots.get(node, process) != process and self.begun
        if memory is not None and memory.node == node and again:
            text = f"{node}, which keeps the global memory, was started again"
            self.remarks[MEMORY] = f"{text} at {now - self.begun:.1f} s: what it held is lost"
            _log.warning("%s: what the global memory held is lost", text)

    def _send_seed(self, now: float, node: str) -> None:
        """Tell the seed to the devices that no call reaches."""
        if self.executor.directory.without_actions(node):
            caller, seed = self.callers[node], {SEED: self.executor.seed}
            identity = f"{self.executor.mission}/{caller.hello.epoch}/{SEED}"
            caller.command(now, Command(identity, SEED, data=seed))


def _verdicts(said: Any) -> list[RunVerdict]:
    """Return the verdicts of a score. Raises MissionError if they are not {run: {status, cause,
    text}}."""
    try:
        return [RunVerdict.of_data({**verdict, "run": run}) for run, verdict in said.items()]
    except (AttributeError, TypeError, ValueError) as fault:
        text = (
            f"score: {VERDICTS}: {fault}; give {{run: {{status, cause, text}}}} with the runs' ids"
        )
        raise MissionError(text) from fault
