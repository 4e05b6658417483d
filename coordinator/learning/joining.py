"""Two states of one selector, learned apart (on two machines, or in a file and its copy), as one:
context by context.

Probabilities cannot be added, so of each context the learner that has learned from more trials is
kept whole.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

State = Mapping[str, Any]


def trials(state: State) -> float:
    """Trials that a state has learned from, in all contexts. Raises KeyError, TypeError or
    ValueError if it is no state."""
    return sum(float(learner["k"]) for learner in state["learners"].values())


def joined(mine: State, other: State) -> dict[str, Any]:
    """Of each context the learner with more trials; `frozen` as in `mine`.

    States over other actions do not mix: the one with more trials is kept whole. Contexts come out
    sorted, ties are settled by the learners' text, so that files which met agree whoever took in
    whom.
    """
    if list(mine["actions"]) != list(other["actions"]):
        return {**(other if _rank(other) > _rank(mine) else mine), "frozen": mine["frozen"]}
    learners = dict(mine["learners"])
    for context, learner in other["learners"].items():
        if context not in learners or _weight(learner) > _weight(learners[context]):
            learners[context] = learner
    return {**mine, "learners": dict(sorted(learners.items()))}


def _rank(state: State) -> tuple[float, str]:
    return trials(state), json.dumps(state["learners"], sort_keys=True)


def _weight(learner: Mapping[str, Any]) -> tuple[float, str]:
    return float(learner["k"]), json.dumps(learner, sort_keys=True)
