"""Stability, recoverability, controllability: small cells with known answers, random nets by
definition."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from petrobot.coordinator.analysis.net.graph import Graph
from petrobot.coordinator.analysis.net.robot import (
    Recovery,
    Roles,
    SpaceWithRoles,
    judge,
    legal_exits,
)
from petrobot.coordinator.analysis.net.space import SearchLimits, explore
from petrobot.coordinator.task.net import Marking, Net
from tests.analysis.random_nets import state_machines


def arm(attempts: int, *, give_up: bool = True, renewed: bool = True) -> Net:
    """One action with an error exit, `attempts` retries, a proper end, and a repair that closes
    the net."""
    arcs: dict[str, tuple[dict[str, int], dict[str, int]]] = {
        "start": ({"idle": 1, "runs": 1}, {"move": 1}),
        "done": ({"move": 1}, {"idle": 1, "runs": 1}),
        "fault": ({"move": 1}, {"recover": 1, "runs": 1}),
        "recovered": ({"recover": 1}, {"clean": 1}),
        "again": ({"recover": 1, "left": 1}, {"recover": 1, "used": 1}),
        "forgive": ({"clean": 1, "used": 1}, {"clean": 1, "left": 1}),
        "back": ({"clean": 1}, {"idle": 1}),
    }
    if give_up:
        arcs["give_up"] = ({"recover": 1}, {"out_of_order": 1})
    if renewed:
        arcs["repair"] = (
            {"out_of_order": 1, "used": attempts} if attempts else {"out_of_order": 1},
            {"idle": 1, "left": attempts} if attempts else {"idle": 1},
        )
    places = {
        "idle": 1,
        "runs": 1,
        "move": 0,
        "recover": 0,
        "clean": 0,
        "left": attempts,
        "used": 0,
        "out_of_order": 0,
    }
    return Net.build(
        places,
        arcs,
        inhibitors={"back": {"used": 1}, "give_up": {"left": 1}}
        if give_up
        else {"back": {"used": 1}},
    )


def roles_of(net: Net, *, renewals: bool = True) -> Roles:
    error = [net.place_index[p] for p in ("recover", "clean", "used", "out_of_order")]

    def nominal(marking: Marking) -> bool:
        return not any(marking[p] for p in error)

    exits = {"fault", "again", "give_up"} & set(net.transitions)
    return Roles(
        nominal,
        frozenset(exits),
        frozenset({"start"}),
        {"move": frozenset({"start"})},
        frozenset({"start"}),
        frozenset({"done"}),
        frozenset({"repair"}) & frozenset(net.transitions),
    )


def by_name(found: tuple[Recovery, ...], name: str) -> Recovery:
    return next(r for r in found if r.error_exit == name)


@pytest.mark.parametrize("attempts", [1, 2, 3])
def test_kappa_counts_the_errors_that_recovery_survives(attempts: int) -> None:
    net = arm(attempts, renewed=False)
    fault = by_name(judge(explore(net), roles_of(net)).recoveries, "fault")
    assert fault.possible.holds is True
    assert fault.almost_sure.holds is False and fault.almost_sure.witness is not None
    assert fault.kappa == attempts
    assert fault.strategy == ("recovered", "back")
    assert fault.resumed is False
    assert (
        by_name(judge(explore(net), roles_of(net)).recoveries, "again").kappa == 0
    )  # after the last attempt


def test_a_repair_makes_recovery_almost_sure_and_kappa_unlimited() -> None:
    net = arm(2)
    verdicts = judge(explore(net), roles_of(net))
    assert all(r.almost_sure.holds for r in verdicts.recoveries)
    assert (
        verdicts.lyapunov is not None
        and verdicts.stable.holds
        and verdicts.attracted.holds
        and verdicts.controllable.holds
    )
    assert by_name(verdicts.recoveries, "fault").kappa is None
    alone = judge(explore(net), roles_of(net), explore(arm(2, renewed=False)))
    assert (
        by_name(alone.recoveries, "fault").kappa == 2
        and by_name(alone.recoveries, "give_up").kappa == -1
    )
    assert by_name(alone.recoveries, "fault").almost_sure.holds


def test_a_missing_recovery_is_caught_with_a_witness() -> None:
    net = Net.build(
        {"idle": 1, "move": 0, "broken": 0},
        {
            "start": ({"idle": 1}, {"move": 1}),
            "done": ({"move": 1}, {"idle": 1}),
            "fault": ({"move": 1}, {"broken": 1}),
        },
    )
    roles = Roles(
        lambda m: m[2] == 0,
        frozenset({"fault"}),
        frozenset({"start"}),
        {"move": frozenset({"start"})},
    )
    verdicts = judge(explore(net), roles)
    (fault,) = verdicts.recoveries
    assert fault.possible.holds is False and fault.kappa == -1 and fault.resumed is None
    assert fault.possible.witness is not None and fault.possible.witness.firings == (
        "start",
        "fault",
    )
    assert verdicts.stable.holds is False and verdicts.attracted.witness is not None
    assert verdicts.controllable.holds is False and verdicts.unforced == ("move",)


def test_a_resumed_run_can_still_meet_its_goal() -> None:
    net = Net.build(
        {"runs": 2, "idle": 1, "move": 0, "recover": 0},
        {
            "start": ({"idle": 1, "runs": 1}, {"move": 1}),
            "done": ({"move": 1}, {"idle": 1, "runs": 1}),
            "fault": ({"move": 1}, {"recover": 1}),
            "retry": ({"recover": 1}, {"move": 1}),
        },
    )
    roles = Roles(
        lambda m: m[3] == 0,
        frozenset({"fault"}),
        frozenset({"start"}),
        {"move": frozenset({"start", "retry"})},
        frozenset({"start"}),
        frozenset({"done"}),
    )
    (fault,) = judge(explore(net), roles).recoveries
    assert fault.resumed is True and fault.kappa is None and fault.almost_sure.holds


def test_only_uncontrollable_exits_from_the_legal_set_are_reported() -> None:
    net = arm(1)
    fine = legal_exits(explore(net), roles_of(net), lambda m: m[net.place_index["move"]] == 0)
    assert fine.holds is True
    bad = legal_exits(explore(net), roles_of(net), roles_of(net).nominal)
    assert (
        bad.holds is False and bad.witness is not None and bad.witness.firings == ("start", "fault")
    )


def test_an_incomplete_space_proves_nothing() -> None:
    net = Net.build({"p": 1}, {"grow": ({"p": 1}, {"p": 2})})
    with pytest.raises(ValueError, match="all reachable markings"):
        SpaceWithRoles(explore(net, limits=SearchLimits(states=5)), Roles(lambda m: True))


@settings(max_examples=60, deadline=None)
@given(state_machines(tokens=1), st.data())
def test_almost_sure_attraction_is_the_value_one_of_the_decision_process(
    net: Net, data: st.DataObject
) -> None:
    """Against an enumeration of all memoryless strategies.

    A strategy leaves out free edges; all others are equally likely. A vertex wins if and only if
    under some strategy every vertex that is reached can still reach the goal.
    """
    space = explore(net)
    edges, n = len(space.target), len(space)
    assume(0 < edges <= 9)
    free = np.array(data.draw(st.lists(st.booleans(), min_size=edges, max_size=edges)))
    goal = np.arange(n) == data.draw(st.integers(0, n - 1))
    graph = Graph(n, space.source, space.target)
    expected = np.zeros(n, dtype=bool)
    choices = np.flatnonzero(free)
    for pick in range(1 << len(choices)):
        kept = ~free
        kept[choices[[bool(pick >> k & 1) for k in range(len(choices))]]] = True
        kept &= ~goal[space.source]
        can = graph.backward(goal, kept)
        for v in range(n):
            reached = graph.forward([v], kept)
            expected[v] |= bool(can[reached].all())
    assert np.array_equal(graph.almost_sure(goal, free), expected)
