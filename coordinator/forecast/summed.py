"""Training from an estimates file, where only sums and samples of runs are left: every run stands
for itself, without history.

So nothing can be unfolded by what had ended before, and the bootstrap is one over runs. A
campaign's folder is the better source.
"""

from __future__ import annotations

from pathlib import Path

from petrobot.coordinator.campaign.observed import context_of, regime_of
from petrobot.coordinator.campaign.throws import RunEntry, Throw
from petrobot.coordinator.experience.estimates_file import EstimatesError, EstimatesFile
from petrobot.coordinator.forecast.history import Training
from petrobot.coordinator.forecast.registered import ForecastError
from petrobot.coordinator.learning.estimate import CENSORED, Tally
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.task import Kind, Task


def read_estimates(path: Path) -> Estimates:
    """What an estimates file holds. Raises ForecastError."""
    try:
        kept = EstimatesFile(path).read() if path.exists() else None
    except EstimatesError as fault:
        raise ForecastError(str(fault)) from fault
    if kept is None or not kept.estimates.tallies:
        raise ForecastError(
            f"{path} holds no estimates; give a campaign's folder or a file that `run "
            "--learn` wrote"
        )
    return kept.estimates


def trainings_of(task: Task, estimates: Estimates) -> dict[str, Training]:
    """Of estimates, by regime."""
    regimes = sorted({regime_of(key.context) for key in estimates.tallies})
    return {
        regime: Training.of(task, _throws(task, estimates, regime), whole=False)
        for regime in regimes
    }


def _throws(task: Task, estimates: Estimates, regime: str) -> list[Throw]:
    """A throw of its own for each run of the samples, as often as it stands for a run that was
    counted."""
    flat, context = task.flat, context_of(regime)
    out: list[Throw] = []
    for place in flat.places.values():
        if place.kind is not Kind.ACTION:
            continue
        for key, tally in estimates.tallies.items():
            if (key.primitive_task, key.context) == (place.task, context):
                out += [Throw(1, 0.0, runs=[run]) for run in _runs(place.name, key.action, tally)]
    for where, flow in estimates.flows.items():
        if (where.task, where.context) == (task.name, context) and flow.waits.n:
            out.append(Throw(1, 0.0, waits=[(where.transition, flow.waits.mean)]))
    return out


def _runs(place: str, action: str, tally: Tally) -> list[RunEntry]:
    """Runs with the counts of the tally and the durations of its sample (each exit's, again and
    again; its mean without any)."""
    out: list[RunEntry] = []
    for exit_, moments in tally.durations.items():
        counted, _, transition = exit_.partition(":")
        seconds = tally.sample.seconds([exit_]) or [moments.mean]
        status = "" if counted == CENSORED else counted
        for i in range(moments.n):
            took = seconds[i % len(seconds)]
            out.append(
                RunEntry(
                    place, action, 0.0, took, status, taken=transition, cancelled=bool(transition)
                )
            )
    return out
