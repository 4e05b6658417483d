"""How commands learn: the options of `run`, the session that is opened on the estimates file, and
its saving."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.services.host.command_line import probability

if TYPE_CHECKING:
    from petrobot.coordinator.learning.session import LearningSession
    from petrobot.coordinator.run.interfaces import FirstAlternative
    from petrobot.coordinator.task import Task
    from petrobot.services.comm.location_file import Directory

SELECTORS = (
    "nikolic_fu",
    "nikolic_fu_fast",
    "tracking",
    "reward_inaction",
    "discretised_pursuit",
    "ucb1",
    "thompson",
    "fixed",
    "round_robin",
)
"""Names for --help without importing numpy; a test compares them with the selectors that there
are."""


def add_learning_arguments(parser: argparse.ArgumentParser) -> None:
    """Whether, where and how a command learns."""
    parser.add_argument(
        "--learn",
        metavar="FILE",
        type=Path,
        help="learn which actions are best, and keep it in this estimates file",
    )
    parser.add_argument(
        "--selector",
        choices=SELECTORS,
        metavar="NAME",
        help=f"who chooses: {', '.join(SELECTORS)} (with --learn)",
    )
    parser.add_argument(
        "--target",
        type=probability,
        metavar="R",
        help="choose among actions that reach this reliability (with --learn)",
    )
    parser.add_argument(
        "--context",
        action="append",
        metavar="NAME|CONDITION",
        help="learn apart for each value of a parameter or variable, or for a condition "
        "(default: regime, if there is one)",
    )
    parser.add_argument(
        "--frozen",
        action="store_true",
        help="choose the best that was learned, and learn nothing (with --learn)",
    )


def opened(
    task: Task, directory: Directory, chosen: Mapping[str, str], options: argparse.Namespace
) -> LearningSession | None:
    """The session that the options ask for; None if they ask for none, and then no file is read."""
    if options.learn is None:
        for name in ("selector", "target", "context", "frozen"):
            if getattr(options, name):
                raise CommandError(
                    2, f"--{name} needs --learn FILE: without it nothing is learned or read"
                )
        return None
    from petrobot.coordinator.learning.estimates_file import EstimatesError
    from petrobot.coordinator.learning.selectors import DEFAULT
    from petrobot.coordinator.learning.session import LearningSession, LearningSetting

    contexts = None if options.context is None else tuple(part for part in options.context if part)
    declared = (
        {a.name: a.compute_time for a in directory.actions.values()}
        if options.mode == "lockstep"
        else None
    )
    setting = LearningSetting(
        options.learn,
        options.selector or DEFAULT,
        options.target,
        contexts,
        chosen,
        options.frozen,
        declared,
    )
    try:
        return LearningSession(task, setting, options.seed)
    except (EstimatesError, ValueError) as fault:
        raise CommandError(2, str(fault)) from fault


@contextmanager
def saved(session: LearningSession | None) -> Iterator[dict[str, Any]]:
    """Save what a mission run learned, also when it is interrupted; what is yielded then holds what
    the result says of it."""
    told: dict[str, Any] = {}
    try:
        yield told
    except BaseException:
        if session is not None:
            _save(session, interrupted=True)
        raise
    if session is not None:
        told["learned"] = _save(session, interrupted=False)


def _save(session: LearningSession, *, interrupted: bool) -> dict[str, Any]:
    from petrobot.coordinator.learning.estimates_file import EstimatesError

    try:
        runs = session.save(interrupted=interrupted)
    except EstimatesError as fault:
        raise CommandError(2, str(fault)) from fault
    learning, values = session.learning, session.selector.context
    for name, action, measure in learning.uncosted():
        print(
            f"{name}: no run of {action} reported {measure}, so its cost was taken as 0; "
            "correct `cost` in the task file or the "
            "name in the action's result",
            file=sys.stderr,
        )
    return {
        "file": str(session.setting.path),
        "selector": session.setting.selector,
        "context": values,
        "runs_counted": runs,
        "probabilities": {
            name: {a: round(p, 4) for a, p in selector.learned(values).items()}
            for name, selector in learning.selectors.items()
        },
    }


def resumed_selector(
    task: Task, header: Mapping[str, Any]
) -> tuple[FirstAlternative, LearningSession | None]:
    """Who chose in a recorded run, as at its beginning."""
    from petrobot.coordinator.learning.estimates_file import EstimatesError
    from petrobot.coordinator.learning.session import fixed_by_user, session_of
    from petrobot.coordinator.run.interfaces import FirstAlternative

    try:
        session = session_of(task, header)
    except (EstimatesError, ValueError) as fault:
        raise CommandError(2, str(fault)) from fault
    return (
        FirstAlternative(fixed_by_user(header)) if session is None else session.selector
    ), session
