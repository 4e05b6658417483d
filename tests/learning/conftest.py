"""Strategies and small tasks for the tests of learning."""

from __future__ import annotations

from hypothesis import strategies as st

from petrobot.coordinator.learning.estimate import Observation, Tally
from petrobot.coordinator.task import Executed, Status

SECONDS = st.floats(0.001, 100.0)
COUNTED = st.builds(
    Observation,
    st.sampled_from(Status),
    SECONDS,
    st.sampled_from(["", "late", "lost"]),
    st.sampled_from([Executed.YES, Executed.UNKNOWN]),
    st.none() | SECONDS,
    st.dictionaries(st.sampled_from(["images", "energy"]), SECONDS, max_size=2),
    st.sampled_from([None, "caught"]),
    st.none() | SECONDS,
)
CENSORED = st.builds(Observation, st.none(), SECONDS, preempted_by=st.sampled_from(["", "caught"]))
MISSING = st.builds(
    Observation, st.just(Status.ERROR), st.just(0.0), st.just("unreachable"), st.just(Executed.NO)
)
OBSERVATIONS = st.lists(COUNTED | CENSORED | MISSING, max_size=25)


def tally_of(seen: list[Observation], salt: str = "") -> Tally:
    """Return the tally of some runs."""
    tally = Tally()
    for one in seen:
        tally = tally.adding(one, salt)
    return tally
