"""Steps and conflicts: what fires together, in which order, and what decides a conflict."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, strategies as st

from petrobot.coordinator.engine import (
    AddTokens,
    Begin,
    CancelRun,
    Chosen,
    Engine,
    EventOccurred,
    Finished,
    Fired,
    Mode,
    Pause,
    Policy,
    RemoveTokens,
    Resume,
    RunEnded,
    StopConfirmed,
    Subject,
)
from petrobot.coordinator.engine.step import RECORDED
from petrobot.coordinator.task import Executed, Status
from tests.engine.conftest import Play, make_task

Plays = Callable[..., Any]


def test_event_free_transitions_follow_until_stable(play: Plays) -> None:
    p = play("x=1 y z", {"t": {"in": "x", "out": "y"}, "u": {"in": "y", "out": "z"}})
    assert p.fired == ["t", "u"] and p.marked == {"z": 1}


def test_timeless_cycle_pauses(play: Plays) -> None:
    p = play(
        "x=1 y",
        {"t": {"in": "x", "out": "y"}, "u": {"in": "y", "out": "x"}},
        policy=Policy(firing_limit=10),
    )
    assert len(p.fired) == 10 and p.state.mode is Mode.PAUSED and p.reports == ["timeless"]


def test_a_net_that_fires_without_end_is_given_up(play: Plays) -> None:
    """An unattended run must not wait for ever for an operator to continue it."""
    p = play("x=3 y", {"t": {"in": "x", "out": "y"}, "u": {"in": "y", "out": "x"}})
    (finished,) = p.of(Finished)
    assert (
        finished.status is Status.ERROR
        and "transitions fired without time passing, last" in finished.reason
    )
    assert p.state.mode is Mode.FINISHED and p.reports == ["timeless"]
    assert 1_000 + 2 * (3 + 2) <= len(p.fired) < 1_000 + 2 * (3 + 2) + 4


def test_runs_of_a_net_that_is_given_up_are_stopped_first(play: Plays) -> None:
    net = {"t": {"in": "x", "out": "y"}, "u": {"in": "y e", "out": "x e"}}
    p = play("x=1 y e a!=1", {**net, "go": {"in": "a:normal"}, "no": {"in": "a:error"}})
    assert p.started == ["a#1"]
    p(AddTokens("e", 1))
    assert p.of(CancelRun) and p.finished is None
    p(StopConfirmed("a#1", Executed.YES))
    assert p.state.mode is Mode.FINISHED


@pytest.mark.parametrize(
    ("places", "net", "fired"),
    [
        ("x=1200 y", {"t": {"in": "x", "out": "y"}}, 1_200),
        (
            "x=1 y z",
            {"t": {"in": "x", "out": "y*40"}, "u": {"in": "y", "out": "z*40"}, "v": {"in": "z"}},
            1_641,
        ),
        ("x=800 y k=800 z", {"t": {"in": "x", "out": "y"}, "u": {"in": "y k", "out": "x"}}, 2_400),
    ],
    ids=["many tokens", "tokens that multiply", "a loop that a store of tokens ends"],
)
def test_a_net_that_comes_to_an_end_may_fire_often(
    play: Plays, places: str, net: dict[str, dict[str, str]], fired: int
) -> None:
    """A net whose structure guarantees an end needs no limit, however many tokens there are."""
    p = play(places, net)
    assert len(p.fired) == fired and p.reports == [] and p.state.mode is not Mode.PAUSED


def test_time_between_stimuli_makes_firings_no_cycle(play: Plays) -> None:
    net = {
        "t": {"in": "x", "out": "y", "event": "e"},
        "u": {"in": "y", "out": "z"},
        "v": {"in": "z", "out": "x"},
    }
    p = play("x=1 y z", net, "e", policy=Policy(firing_limit=4))
    p(EventOccurred("e"), EventOccurred("e"))
    assert len(p.fired) == 6 and p.reports == []


def test_step_orders_transitions_so_that_none_bars_the_next(play: Plays) -> None:
    net = {
        "t": {"in": "x", "out": "y", "event": "e"},
        "u": {"in": "v !y", "out": "z", "event": "e"},
        "w": {"in": "r !z", "event": "e"},
    }
    p = play("x=1 y v=1 z r=1", net, "e")
    p(EventOccurred("e"))
    assert p.fired == ["w", "u", "t"]


def test_step_is_judged_on_one_marking(play: Plays) -> None:
    net = {
        "t": {"in": "x !y", "out": "z", "event": "e"},
        "u": {"in": "w", "out": "y", "event": "e"},
    }
    p = play("x=1 y w=1 z", net, events="e")
    p(EventOccurred("e"))
    assert p.fired == ["t", "u"] and p.marked == {"z": 1, "y": 1}


def test_conflict_decided_by_priority(play: Plays) -> None:
    net = {
        "t": {"in": "x", "out": "y", "event": "e"},
        "u": {"in": "x", "out": "z", "event": "e", "priority": 1},
    }
    p = play("x=1 y z", net, events="e")
    p(EventOccurred("e"))
    assert p.fired == ["u"] and p.reports == []


def test_priority_decides_conflicts_only(play: Plays) -> None:
    net = {
        "t": {"in": "x", "out": "y", "event": "e"},
        "u": {"in": "w", "out": "z", "event": "e", "priority": 1},
    }
    p = play("x=1 w=1 y z", net, events="e")
    p(EventOccurred("e"))
    assert sorted(p.fired) == ["t", "u"]


def test_what_goes_first_for_an_inhibitor_takes_nothing_from_a_higher_priority(
    play: Plays,
) -> None:
    """`t` would bar `u`, so `u` goes first; but its token belongs to `w`, which nothing bars."""
    net = {
        "t": {"in": "x", "out": "y", "event": "e", "priority": 1},
        "u": {"in": "r !y", "event": "e"},
        "w": {"in": "r", "out": "z", "event": "e", "priority": 1},
    }
    p = play("x=1 y r=1 z", net, events="e")
    p(EventOccurred("e"))
    assert sorted(p.fired) == ["t", "w"] and p.marked == {"y": 1, "z": 1}
    older = play("x=1 y r=1 z", net, events="e", policy=RECORDED[5])
    older(EventOccurred("e"))
    assert older.fired == ["u", "t"], "a journal with `semantics` 5 is replayed as it was recorded"


def test_conflict_drawn_by_weight(play: Plays) -> None:
    net = {
        "t": {"in": "x", "out": "y", "event": "e", "weight": 1.0},
        "u": {"in": "x", "out": "z", "event": "e", "weight": 3.0},
    }
    p = play("x=1 y z", net, events="e")
    (choose,) = p(EventOccurred("e"))
    assert (choose.subject, choose.alternatives, choose.weights) == (
        Subject.CONFLICT,
        ("t", "u"),
        (1.0, 3.0),
    )
    assert p.fired == []
    p(Chosen(choose.key, "w"))
    assert p.reports == ["bad_choice"] and p.fired == []
    p(Chosen(choose.key, "u", "draw 0.4"))
    assert p.fired == ["u"] and p.marked == {"z": 1}


def test_transitions_without_conflict_fire_in_the_step_of_the_drawn_one(play: Plays) -> None:
    net = {
        "t": {"in": "x", "out": "y", "event": "e", "weight": 1.0},
        "u": {"in": "x", "out": "z", "event": "e", "weight": 1.0},
        "v": {"in": "w", "out": "z", "event": "e"},
    }
    p = play("x=1 w=1 y z", net, events="e")
    (choose,) = p(EventOccurred("e"))
    p(Chosen(choose.key, "t"))
    assert sorted(p.fired) == ["t", "v"] and {f.cause for f in p.of(Fired)} == {"EventOccurred"}


def test_three_takers_of_two_tokens_are_drawn_one_after_the_other(play: Plays) -> None:
    net = {n: {"in": "x", "out": n + "1", "event": "e", "weight": 1.0} for n in ("t", "u", "v")}
    p = play("x=2 t1 u1 v1", net, events="e")
    (first,) = p(EventOccurred("e"))
    assert first.alternatives == ("t", "u", "v")
    (second,) = p(Chosen(first.key, "v"))
    assert second.alternatives == ("t", "u") and second.key != first.key
    p(Chosen(second.key, "u"))
    assert sorted(p.fired) == ["u", "v"] and p.marked == {"u1": 1, "v1": 1}


def test_stimuli_wait_while_a_draw_is_outstanding(play: Plays) -> None:
    net = {
        "t": {"in": "x", "out": "y", "event": "e", "weight": 1.0},
        "u": {"in": "x", "out": "z", "event": "e", "weight": 1.0},
        "v": {"in": "y", "out": "w", "event": "e"},
    }
    p = play("x=1 y z w", net, events="e")
    (choose,) = p(EventOccurred("e"))
    p(EventOccurred("e"))
    assert len(p.state.backlog) == 1
    p(Chosen(choose.key, "t"))
    assert p.fired == ["t", "v"] and p.state.backlog == ()


def test_an_undecided_conflict_is_decided_by_file_order_and_reported(play: Plays) -> None:
    net = {"t": {"in": "x", "out": "y", "event": "e"}, "u": {"in": "x", "out": "z", "event": "e"}}
    p = play("x=1 y z", net, events="e")
    p(EventOccurred("e"))
    assert p.fired == ["t"] and p.reports == ["undecided"]


ARM = {
    "hold": {"in": "go arm", "out": "c"},
    "free": {"in": "c:normal", "out": "arm"},
    "first": {"in": "a:normal arm", "out": "arm done_a"},
    "second": {"in": "b:normal arm", "out": "arm done_b"},
}
"""`first` and `second` need the arm, which c holds."""


def ended(run: str) -> RunEnded:
    return RunEnded(run, Status.SUCCESS)


@pytest.mark.parametrize(
    ("ends", "served"),
    [(("a#1", "b#1"), ["first", "second"]), (("b#1", "a#1"), ["second", "first"])],
)
def test_a_conflict_over_a_resource_is_decided_first_come_first_served(
    play: Plays, ends: tuple[str, ...], served: list[str]
) -> None:
    p = play("go=1 arm~=1 a!=1 b!=1 c! done_a done_b", ARM)
    p(*map(ended, ends))
    assert [wait.since for wait in p.state.waits.values()] and p.fired == ["hold"]
    p(ended("c#1"))
    assert p.fired == ["hold", "free", *served] and p.reports == [] and not p.state.waits


@given(st.permutations(range(4)))
def test_a_queue_for_a_resource_is_served_in_the_order_of_its_arrivals(order: list[int]) -> None:
    net = {"hold": {"in": "go arm", "out": "c"}, "free": {"in": "c:normal", "out": "arm"}}
    net |= {f"take{i}": {"in": f"a{i}:normal arm", "out": "c"} for i in range(4)}
    places = "go=1 arm~=1 c! " + " ".join(f"a{i}!=1" for i in range(4))
    p = Play(Engine(make_task(places, net), {}, Policy(end_when_dead=False)))
    p(Begin(), *(ended(f"a{i}#1") for i in order))
    p(*(ended(f"c#{n}") for n in range(1, 5)))
    assert [name for name in p.fired if name.startswith("take")] == [f"take{i}" for i in order]
    assert p.reports == []


def test_transitions_that_wait_since_the_same_stimulus_fire_in_file_order(play: Plays) -> None:
    p = play("go=1 arm~=1 x a!=1 b!=1 c! done_a done_b", ARM, policy=Policy(end_when_dead=False))
    p(Pause(), ended("b#1"), ended("a#1"), Resume())
    waits = {name: wait.since for name, wait in p.state.waits.items()}
    assert waits == {"second": 3, "first": 4}  # they waited while the net was paused
    net = {"both": {"in": "s:normal", "out": "x y"}, "t": {"in": "x r"}, "u": {"in": "y r"},
           "give": {"in": "h:normal", "out": "r"}}  # fmt: skip
    p = play("s!=1 h!=1 x y r", net)
    p(ended("s#1"))
    assert {wait.since for wait in p.state.waits.values()} == {2}
    p(ended("h#1"))
    assert p.fired == ["both", "give", "t"] and p.reports == ["undecided"]


def test_a_wait_ends_when_something_else_is_lacking(play: Plays) -> None:
    """`second` waited first, loses its own token for a while, and must queue again."""
    net = {**ARM, "second": {"in": "ticket arm", "out": "arm done_b"}}
    p = play("go=1 arm~=1 ticket=1 a!=1 c! done_a done_b", net)
    assert p.state.waits["second"].since == 1
    p(ended("a#1"), RemoveTokens("ticket"), AddTokens("ticket"))
    p(ended("c#1"))
    assert p.fired == ["hold", "free", "first", "second"]


def test_old_journals_keep_the_order_in_the_file(play: Plays) -> None:
    p = play("go=1 arm~=1 a!=1 b!=1 c! done_a done_b", ARM, policy=RECORDED[3])
    p(ended("b#1"), ended("a#1"), ended("c#1"))
    assert p.fired == ["hold", "free", "first", "second"] and not p.state.waits


def test_exclusive_conditions_are_no_conflict(play: Plays) -> None:
    net = {
        "t": {"in": "x", "out": "y", "event": "e", "when": "n > 3"},
        "u": {"in": "x", "out": "z", "event": "e", "when": "n <= 3"},
    }
    p = play("x=1 y z", net, events="e", variables={"n": 4})
    p(EventOccurred("e"))
    assert p.fired == ["t"] and p.reports == []


def test_one_latched_event_serves_one_of_two(play: Plays) -> None:
    net = {
        "t": {"in": "x", "out": "y", "event": "e"},
        "u": {"in": "w", "out": "z", "event": "e", "priority": 1},
    }
    p = play("x=1 w=1 y z", net, events="e*")
    p(EventOccurred("e"))
    assert p.fired == ["u"]
    p(EventOccurred("e"))
    assert p.fired == ["u", "t"]


def test_mutual_inhibition_is_a_conflict(play: Plays) -> None:
    net = {
        "t": {"in": "x !z", "out": "y", "event": "e"},
        "u": {"in": "w !y", "out": "z", "event": "e", "priority": 1},
    }
    p = play("x=1 w=1 y z", net, events="e")
    p(EventOccurred("e"))
    assert p.fired == ["u"]


def test_capacity_bars_a_firing_until_there_is_room(play: Plays) -> None:
    net = {"t": {"in": "x", "out": "y"}, "u": {"in": "y", "event": "e"}}
    p = play("x=3 y/2", net, "e")
    assert p.marked == {"x": 1, "y": 2}
    p(EventOccurred("e"))
    assert p.fired == ["t", "t", "u", "t"] and p.marked == {"y": 2}
