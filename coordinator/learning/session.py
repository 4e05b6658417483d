"""Learning of one mission run: opened on an estimates file, described in the journal for a resume,
and saved once."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.learning.estimates_file import (
    EstimatesError,
    EstimatesFile,
    FileContents,
    said,
)
from petrobot.coordinator.learning.learner import Contexts, LearningSelector, usual_contexts
from petrobot.coordinator.learning.learning import Estimates, Learning
from petrobot.coordinator.learning.objective import Question
from petrobot.coordinator.learning.records import Correction, RunEnd
from petrobot.coordinator.learning.selectors import ACTION, DEFAULT, RULES, credited
from petrobot.coordinator.task import Task
from petrobot.services.comm.location_file import DRY_RUN, MOCK

PRIOR_TRIALS = 10.0
"""Trials for which a prior counts unless the user says otherwise. The error of a simulator is not
known beforehand. If its R of an action has an error of 0.1 (standard deviation), it is worth
0.9 * 0.1 / 0.1^2 = 9 real runs of an action with R = 0.9, and 25 of one with R = 0.5."""


class LearningSetting(Struct, frozen=True):
    """How a mission run learns. `contexts`: what distinguishes contexts (None: the regime, if the
    task has one)."""

    path: Path
    selector: str = DEFAULT
    target: float | None = None
    """Target reliability: choose the lowest J among the actions that meet it; None: the lowest J of
    all."""
    contexts: tuple[str, ...] | None = None
    chosen: Mapping[str, str] = field(default_factory=dict)
    """Actions that the user fixed, by primitive task."""
    frozen: bool = False
    """Choose by what was learned and write nothing."""
    declared: Mapping[str, float] | None = None
    """In lock step: declared compute time of each action (s)."""
    physics: str = ""
    """Name and version of the simulated laboratory's physics; empty: it has only one, or is
    real."""
    credit: str = ACTION
    """What judges a choice: the end of its own run ("action"), or the task's goal ("task")."""
    plant: str = ""
    """Where the run takes place (`Directory.plant`): what it learns is never pooled with that of
    another plant; empty: a run that was recorded before this was."""
    prior: float | None = None
    """Learners start from what is known of another plant (for a real one: the simulated one), as
    from so many trials of each action; None: from nothing."""

    def to_plain(self) -> dict[str, Any]:
        """Return plain data for a journal's header."""
        return {
            "path": str(self.path.resolve()),
            "selector": self.selector,
            "target": self.target,
            "contexts": None if self.contexts is None else list(self.contexts),
            "chosen": dict(self.chosen),
            "frozen": self.frozen,
            "declared": None if self.declared is None else dict(self.declared),
            "physics": self.physics,
            "credit": self.credit,
            "plant": self.plant,
            "prior": self.prior,
        }

    @classmethod
    def of_plain(cls, data: Mapping[str, Any]) -> LearningSetting:
        """Read what `to_plain` returned."""
        contexts = None if data["contexts"] is None else tuple(data["contexts"])
        given = (
            data["selector"],
            data["target"],
            contexts,
            data["chosen"],
            data["frozen"],
            data["declared"],
        )
        more = (
            data.get("physics", ""),
            data.get("credit", ACTION),
            data.get("plant", ""),
            data.get("prior"),
        )
        return cls(Path(data["path"]), *given, *more)


class LearningSession:
    """Learning of one mission run, between an estimates file and the executor.

    `begun`: for a resumed run, the selectors' states and the generation at the beginning of the
    run, as `beginning()` returned them; None: as the file has them. Raises EstimatesError,
    ContextError or ValueError.
    """

    def __init__(
        self,
        task: Task,
        setting: LearningSetting,
        seed: int,
        begun: Mapping[str, Any] | None = None,
    ) -> None:
        if setting.selector not in RULES:
            raise ValueError(
                f"unknown selector {setting.selector!r}; choose one of {', '.join(RULES)}"
            )
        self.setting = setting
        self.file = EstimatesFile(setting.path)
        if setting.frozen and not setting.path.exists():
            raise EstimatesError(
                f"{setting.path}: no such file: nothing was learned that could be frozen; run with "
                "--learn and without --frozen first"
            )
        if not setting.frozen:
            self.file.refuse_unwritable()
        kept = self.file.read(setting.plant)
        self.file.refuse_other_physics(kept, setting.physics)
        contexts = usual_contexts(task) if setting.contexts is None else Contexts(setting.contexts)
        generation = kept.generation if begun is None else int(begun["generation"])
        self._generation = generation
        self._token = secrets.token_hex(8) if begun is None else str(begun["token"])
        self.learning = _learning(
            task, setting, kept, None if begun is None else begun["selectors"], self._token
        )
        found = _prior(setting, kept)
        self._prior = None if found is None else (found, setting.prior or 0.0)
        self._begun = self.learning.state()
        self.selector = LearningSelector(
            self.learning,
            contexts,
            setting.chosen,
            seed=seed,
            generation=generation,
            live=not setting.frozen,
            declared=setting.declared,
        )

    def beginning(self) -> dict[str, Any]:
        """Return plain data from which a resumed run derives the same choices again."""
        begun = {"token": self._token, "generation": self._generation, "selectors": self._begun}
        return {**self.setting.to_plain(), **begun}

    def save(self) -> int:
        """Add what was learned to the file, and return how many of its runs the file has counted.

        Nothing is added twice: the mission run may be resumed, even a finished one whose
        coordinator died before it wrote its result.
        """
        if self.setting.frozen:
            return 0
        done, records = self.file.records_of(self._token), len(self.selector.records)
        gained, late = (self.learning.gained, ()) if not done else self._gained_after(done)
        if not done or done < records:
            self.file.add(
                gained,
                self.learning.state(),
                self._token,
                records,
                late,
                self.learning.asked(),
                self.setting.physics,
                self.setting.plant,
                self._prior,
            )
        return sum(t.runs + t.censored for t in self.learning.gained.tallies.values())

    def _gained_after(self, done: int) -> tuple[Estimates, Sequence[Correction]]:
        """Return what was learned after so many records, and the verdicts among them on runs that
        the file has already counted."""
        counted = {
            id(record.outcome)
            for record in self.selector.records[:done]
            if isinstance(record, RunEnd)
        }
        gained, late = Estimates(), []
        for record in self.selector.records[done:]:
            if isinstance(record, Correction) and id(record.was) in counted:
                late.append(record)
            else:
                gained.apply(record, self.learning.task.name, self.learning.salt)
        return gained, late


def _learning(
    task: Task,
    setting: LearningSetting,
    kept: FileContents,
    states: Mapping[str, Mapping[str, Any]] | None,
    salt: str,
) -> Learning:
    """Create the learning state. `salt` names the session, so that its runs in the sample differ
    from those of any other session, including one on a copied file."""
    question = Question(target=setting.target)
    learning = Learning(task, setting.selector, question, kept.estimates, salt, setting.credit)
    source = _prior(setting, kept)
    known = states if states is not None else _states(setting, kept, source)
    try:
        learning.restore(known)
    except ValueError as fault:
        raise EstimatesError(
            f"{setting.path}: the state of selector {setting.selector} does not fit: {fault}; "
            "reset it with `petrobot learned reset`"
        ) from fault
    if states is None:
        prior = Estimates() if source is None else kept.plants[source]
        learning.prime(prior, setting.prior or 0.0)
    if setting.frozen:
        learning.freeze()
    return learning


def _prior(setting: LearningSetting, kept: FileContents) -> str | None:
    """Return the plant whose estimates are the prior; None without one. Raises EstimatesError."""
    if setting.prior is None:
        return None
    if setting.credit != ACTION:
        raise EstimatesError(
            "--prior needs --credit action: estimates hold no verdicts of the task; leave one out"
        )
    useless = (setting.plant, DRY_RUN, MOCK)
    others = [p for p in kept.plants if p not in useless and kept.plants[p].tallies]
    if not others and not setting.frozen:
        raise EstimatesError(
            f"{setting.path}: --prior needs runs of another plant than {said(setting.plant)} in "
            "the file; merge the simulated estimates into it with `petrobot learned merge`, or "
            "leave --prior out"
        )
    return min(others, key=kept.rank, default=None)


def _states(
    setting: LearningSetting, kept: FileContents, prior: str | None
) -> Mapping[str, Mapping[str, Any]]:
    """Return the states of the selectors in this plant. If nothing was learned in it, a frozen run
    chooses by those of the prior, or of a file that does not say its plant. Raises EstimatesError
    where it could only choose by another plant's."""
    name = credited(setting.selector, setting.credit)
    states = kept.states(name)
    if states or not setting.frozen:
        return states
    by_plant = {plant: replace(kept, plant=plant).states(name) for plant in kept.plants}
    learned = [plant for plant, found in by_plant.items() if found]
    for plant in (prior, ""):
        if plant in learned:
            return by_plant[plant]
    if learned:
        raise EstimatesError(
            f"{setting.path}: --frozen: {name} has learned nothing in this plant "
            f"({said(setting.plant)}), only in: {', '.join(map(said, learned))}; add --prior to "
            "choose by that"
        )
    return {}


def session_of(task: Task, header: Mapping[str, Any]) -> LearningSession | None:
    """Recreate the session of a recorded run as it began; None if the run did not learn. Raises
    EstimatesError or ValueError."""
    begun = header.get("learning")
    if begun is None:
        return None
    try:
        return LearningSession(task, LearningSetting.of_plain(begun), header["seed"], begun)
    except (KeyError, TypeError) as fault:
        raise ValueError(f"the journal's header: `learning` is incomplete: {fault}") from fault


def fixed_by_user(header: Mapping[str, Any]) -> Mapping[str, str]:
    """Return the actions that the user of a recorded run had fixed."""
    chosen: Mapping[str, str] = header.get("chosen", {})
    return chosen
