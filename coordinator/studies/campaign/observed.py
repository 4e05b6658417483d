"""Convert rows of a campaign's table into estimates, and write the estimates file of a campaign."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from petrobot.coordinator.learning.estimate import (
    Firings,
    FiringsKey,
    Observation,
    Tally,
    TallyKey,
    TrialsKey,
    TrialSums,
)
from petrobot.coordinator.learning.estimates_file import EstimatesError, EstimatesFile
from petrobot.coordinator.learning.estimates_tables import CAMPAIGN
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.learning.objective import Question
from petrobot.coordinator.learning.records import Waited, WaitEnd
from petrobot.coordinator.learning.statistics import added
from petrobot.coordinator.studies.campaign.plan import CampaignError
from petrobot.coordinator.studies.campaign.table import TrialRow
from petrobot.coordinator.studies.campaign.trials import RunEntry
from petrobot.coordinator.task import Executed, Status, Task
from petrobot.services.comm.location_file import SIMULATED

ESTIMATES = "estimates.db"


def context_of(regime: str) -> str:
    """Return a regime as the context of estimates and selectors, named as `petrobot run --learn`
    names it."""
    return f"regime={regime}" if regime else ""


def regime_of(context: str) -> str:
    """Return the regime of a context made by `context_of`."""
    return context.removeprefix("regime=")


def observation(task: Task, run: RunEntry) -> Observation:
    """Return a run as an observation. A preempted run that counts none, or a run that did not end,
    is censored. CPU time is what services.toml declares."""
    measure = task.primitive_task_of(run.place).cost
    preempted = run.cancelled and bool(run.taken)
    return Observation(
        Status(run.status) if run.status else None,
        run.took if preempted else max(0.0, run.seconds),
        run.cause,
        Executed(run.executed),
        run.cost if measure == "cpu" else None,
        {} if run.cancelled else run.values,
        run.taken if run.cancelled else None,
        None if run.cancelled else max(0.0, round(run.took - run.seconds, 6)),
        run.judged,
    )


def add_row(estimates: Estimates, task: Task, row: TrialRow, salt: str) -> None:
    """Count the runs and firings of a row."""
    if row.trial is None:
        return
    context = context_of(row.regime)
    for run in row.trial.runs:
        key = TallyKey(task.primitive_task_of(run.place).name, run.action, context)
        name = f"{salt}/{row.regime}/{row.seed}/{row.k}"
        estimates.tallies[key] = estimates.tallies.get(key, Tally()).adding(
            observation(task, run), name
        )
    waits: dict[str, list[Waited]] = {}
    for wait in row.trial.waits:
        waits.setdefault(wait.transition, []).append(wait)
    for transition in dict.fromkeys((*row.trial.fired, *waits)):
        where = FiringsKey(task.name, transition, context)
        flow = estimates.flows.get(where, Firings())
        seconds = [wait.seconds for wait in waits.get(transition, ()) if wait.fired]
        for i in range(row.trial.fired.get(transition, 0)):
            flow = flow.adding(seconds[i] if i < len(seconds) else None)
        for wait in waits.get(transition, ()):
            if not wait.fired:
                flow = flow.unserved(wait.seconds, wait.end is WaitEnd.CAME)
        estimates.flows[where] = flow
    of = TrialsKey(task.name, context)
    costs = [run.cost for run in row.trial.runs]
    known = [cost for cost in costs if cost is not None]
    estimates.trials[of] = estimates.trials.get(of, TrialSums()).adding(
        row.trial.all_success,
        row.trial.goals > 0,
        added(known) if len(known) == len(costs) else None,
        [task.primitive_task_of(run.place).name for run in row.trial.runs],
    )


def estimates_of(task: Task, rows: Iterable[TrialRow], salt: str) -> Estimates:
    """Return the estimates of a whole table. `salt` names the campaign."""
    made = Estimates()
    for row in rows:
        add_row(made, task, row, salt)
    return made


def write_estimates(
    folder: Path,
    estimates: Estimates,
    selectors: Mapping[str, Mapping[str, Any]],
    campaign: str,
    asked: Mapping[str, Question] | None = None,
    physics: str = "",
    plant: str = SIMULATED,
) -> Path:
    """Write the runs of a campaign to its estimates file, under the campaign's own origin, and
    return its path.

    Merging it twice counts nothing twice, and what others have learned into the file stays.
    `asked`: by what the actions of each primitive task are judged; `physics`: that of the
    simulated laboratory; `plant`: SIMULATED, or MOCK for scripted actions. Raises CampaignError.
    """
    path = folder / ESTIMATES
    try:
        origin = CAMPAIGN + campaign
        EstimatesFile(path, origin).put_closed(
            origin, estimates, selectors, asked or {}, physics, plant
        )
    except EstimatesError as fault:
        raise CampaignError(
            f"{fault}. If it is removed, the same command makes it again from the table"
        ) from fault
    return path
