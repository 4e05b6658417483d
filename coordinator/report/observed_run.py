"""What a recorded mission run says of its actions: the steps of its journal shown once more to the
observer that learns from runs.

So R, C, J and choice probabilities of a single run are those that `run --learn` counts, drawn as a
campaign's are.
"""

from __future__ import annotations

from collections.abc import Sequence

from petrobot.coordinator.experience.learner import LearningSelector
from petrobot.coordinator.learning.learning import Learning
from petrobot.coordinator.learning.records import End, Record
from petrobot.coordinator.record.recording import Step
from petrobot.coordinator.report.action_pictures import (
    Pictures,
    action_pictures,
    add_latencies,
    latency_svg,
    put,
    trial_pictures,
)
from petrobot.coordinator.report.trials import Curves, recorded_curves
from petrobot.coordinator.task import Task


class ObservedRun:
    """Observes the steps of a run. `learner`: the selector that learned in it, as it began; None:
    nobody learned."""

    def __init__(self, task: Task, learner: LearningSelector | None = None) -> None:
        self._task = task
        self._learns = learner is not None
        self._selector = learner or LearningSelector(Learning(task))
        self._probability: dict[tuple[str, str], Curves] = {}

    def step(self, step: Step) -> None:
        """See one stimulus and what came of it."""
        seen = len(self._selector.records)
        self._selector.stimulus(step.time, step.stimulus)
        for instruction in step.instructions:
            self._selector.instruction(step.time, instruction)
        self._selector.settled(step.time, step.state)
        if self._learns:
            self._note(self._selector.records[seen:])

    def _note(self, records: Sequence[Record]) -> None:
        """The probabilities after each trial that ended."""
        for record in records:
            selector = (
                None
                if not isinstance(record, End)
                else self._selector.learning.selectors.get(record.primitive_task)
            )
            if selector is None or not isinstance(record, End) or record.outcome.status is None:
                continue
            curves = self._probability.setdefault((record.primitive_task, record.context), {})
            for action, p in selector.learned(record.context).items():
                points = curves.setdefault(action, [])
                points.append((len(points) + 1, p))

    def pictures(self) -> Pictures:
        """Every picture that there are numbers for."""
        trials = recorded_curves(self._task, self._selector.records)
        for one in trials:
            one.probability = (
                self._probability.get((one.primitive_task, one.context), {}) if self._learns else {}
            )
        out = trial_pictures(trials, "learned probability") | action_pictures(
            self._task, self._selector.learning.gained
        )
        latencies: dict[str, list[float]] = {}
        for record in self._selector.records:
            if isinstance(record, End):
                add_latencies(latencies, record.action, record.outcome.values)
        if latencies:
            put(out, "latencies", "Times", latency_svg(latencies))
        return out
