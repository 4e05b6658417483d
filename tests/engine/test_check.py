"""Findings of the check, each with a small faulty task and the same task without the fault."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from msgspec.structs import replace

from petrobot.coordinator.task import Task
from petrobot.coordinator.task.check import Severity, check
from petrobot.coordinator.task.check.conflicts import conflicts
from petrobot.coordinator.task.conditions import parse
from petrobot.coordinator.task.file import loads
from tests.effort import calls

Tasks = Callable[..., Task]
A = {"n": {"in": "a:normal", "out": "y"}, "e": {"in": "a:error", "out": "y"}}
DOOR = {
    "t": {"in": "x !open", "out": "a"},
    "u": {"in": "a:preempt=none !shut", "out": "x"},
    "opens": {"in": "shut", "out": "open", "after": 1.0},
    "shuts": {"in": "open", "out": "shut", "after": 1.0},
}
E, W, N = Severity.ERROR, Severity.WARNING, Severity.NOTE


def found(task: Task, **kwargs: Any) -> dict[str, Any]:
    """Return the findings by code."""
    return {f.code: f for f in check(task, **kwargs).findings}


def test_sound_task_has_no_finding(task: Tasks) -> None:
    report = check(task("a!=1 y", A, final="y == 1"), {"do_a": "node"})
    assert report.findings == () and report.ok


@pytest.mark.parametrize(
    ("code", "severity", "key", "broken"),
    [
        ("no-normal-exit", E, "places.a", lambda t: t("a!=1 y", {"e": A["e"]})),
        ("no-error-exit", E, "places.a", lambda t: t("a!=1 y", {"n": A["n"]})),
        (
            "uncovered-exit",
            E,
            "places.a",
            lambda t: t(
                "a!=1 y", {**A, "n": {"in": "a:normal", "when": "k > 1"}}, variables={"k": 0}
            ),
        ),
        (
            "uncovered-exit",
            E,
            "places.a",
            lambda t: t("a!=1 y", {**A, "n": {"in": "a:normal", "when": "a.status == 'success'"}}),
        ),
        (
            "never-true",
            E,
            "transitions.n.when",
            lambda t: t(
                "a!=1 y",
                {**A, "n": {"in": "a:normal", "when": "k < 2 and k > 4"}, "m": {"in": "a:normal"}},
                variables={"k": 0},
            ),
        ),
        (
            "late-timer",
            W,
            "transitions.late.after",
            lambda t: t("a!=1 y", {**A, "late": {"in": "a:preempt=none", "after": 10.5}}),
        ),
        (
            "equal-timers",
            W,
            "transitions.t",
            lambda t: t(
                "x=1",
                {
                    "t": {"in": "x", "after": 1.0, "weight": 1.0},
                    "u": {"in": "x", "after": 1.0, "weight": 3.0},
                },
            ),
        ),
        (
            "unsettled-conflict",
            W,
            "transitions.t",
            lambda t: t(
                "x=1 y",
                {"t": {"in": "x", "out": "y", "event": "e"}, "u": {"in": "x", "event": "e"}},
                "e",
            ),
        ),
        (
            "unsettled-conflict",
            W,
            "transitions.n",
            lambda t: t("a!=1 y", {**A, "m": {"in": "a:normal", "event": "e"}}, "e*"),
        ),
        (
            "unsettled-conflict",
            W,
            "transitions.t",
            lambda t: t(
                "x=1 w=1", {"t": {"in": "x", "event": "e"}, "u": {"in": "w", "event": "e"}}, "e*"
            ),
        ),
        (
            "unsettled-conflict",
            W,
            "transitions.t",
            lambda t: t(
                "x=1 w=1 y/1",
                {n: {"in": p, "out": "y", "event": "e"} for n, p in (("t", "x"), ("u", "w"))},
                "e",
            ),
        ),
        (
            "unsettled-conflict",
            W,
            "transitions.t",
            lambda t: t(
                "x=1 w=1 y z", {"t": {"in": "x !z", "out": "y"}, "u": {"in": "w !y", "out": "z"}}
            ),
        ),
        (
            "unsettled-conflict",
            W,
            "transitions.t",
            lambda t: t("a!2=2 x=1", {"t": {"in": "a:normal x"}, "u": {"in": "a:error x"}}),
        ),
        (
            "unsettled-conflict",
            W,
            "transitions.t",
            lambda t: t("x=1 y=2", {"t": {"in": "x !y*3"}, "u": {"in": "x y"}}),
        ),
        (
            "arrival-order",
            N,
            "transitions.t",
            lambda t: t(
                "x=1", {"t": {"in": "x", "event": "e"}, "u": {"in": "x", "event": "f"}}, "e f*"
            ),
        ),
        (
            "unsettled-conflict",
            W,
            "transitions.t",
            lambda t: t(
                "x=1", {"t": {"in": "x", "event": "e"}, "u": {"in": "x", "event": "f"}}, "e+ f+"
            ),
        ),
        (
            "arrival-order",
            N,
            "transitions.t",
            lambda t: t(
                "x=1", {"t": {"in": "x", "event": "e"}, "u": {"in": "x", "after": 1.0}}, "e"
            ),
        ),
        (
            "timeless-cycle",
            E,
            "transitions.t",
            lambda t: t("x=1 y", {"t": {"in": "x", "out": "y"}, "u": {"in": "y", "out": "x"}}),
        ),
        ("timeless-cycle", E, "transitions.t", lambda t: t("y", {"t": {"out": "y"}})),
        (
            "timeless-cycle",
            E,
            "transitions.t",
            lambda t: t(
                "x=1 y lid",
                {"t": {"in": "x !lid*2", "out": "y"}, "u": {"in": "y lid", "out": "x lid"}},
            ),
        ),
        (
            "timeless-cycle",
            E,
            "transitions.t",
            lambda t: t("y", {"t": {"in": "!y", "out": "y"}, "u": {"in": "y"}}),
        ),
        ("external-wait", W, "places.x", lambda t: t("x=1", {"t": {"in": "x", "event": "e"}}, "e")),
        (
            "external-wait",
            W,
            "places.a",
            lambda t: t(
                "a!=1", {"n": {"in": "a:normal", "event": "e"}, "e": {"in": "a:error"}}, "e*"
            ),
        ),
        ("never-marked", W, "places.r", lambda t: t("r~ y", {"t": {"in": "r", "out": "y"}})),
        ("never-marked", N, "places.x", lambda t: t("x y", {"t": {"in": "x", "out": "y"}})),
        (
            "final-at-start",
            W,
            "task.final",
            lambda t: t("x y", {"t": {"in": "x", "out": "y"}}, final="x == 0"),
        ),
        (
            "overridden",
            W,
            "task.parameters.seed",
            lambda t: replace(t("a!=1 y", A), parameters={"seed": 1, "regime": "A"}),
        ),
        ("unused", N, "events.e", lambda t: t("a!=1 y", A, "e")),
        (
            "never-written",
            W,
            "variables.k",
            lambda t: t("x=1", {"t": {"in": "x", "when": "k == none"}}, variables={"k": None}),
        ),
        (
            "event-unheard",
            E,
            "transitions.t.event",
            lambda t: t("a!=1 x=1 y", {**A, "t": {"in": "x", "event": "seen"}}, "seen<a"),
        ),
        (
            "internal-impossible",
            E,
            "transitions.start.event",
            lambda t: t(
                "x=1 a! y", {**A, "start": {"in": "x", "out": "a", "event": "tick"}}, "tick<a"
            ),
        ),
        ("inconsistent", E, "transitions.t.in", lambda t: t("x=1", {"t": {"in": "w"}})),
        (
            "inconsistent",
            E,
            "transitions.t.event",
            lambda t: t("x=1", {"t": {"in": "x", "event": "odd"}}),
        ),
        (
            "inconsistent",
            E,
            "transitions.t.event",
            lambda t: t("x=1", {"t": {"in": "x", "event": "e f"}}, "e f"),
        ),
    ],
)
def test_finding(
    task: Tasks, code: str, severity: Severity, key: str, broken: Callable[[Tasks], Task]
) -> None:
    report = check(broken(task))
    keys = {(f.code, f.severity, f.key) for f in report.findings}
    assert (code, severity, key) in keys, str(report)
    assert report.ok is (severity is not E)


def test_refused_internal_tick_says_why(task: Tasks) -> None:
    broken = task("x=1 a! y", {**A, "start": {"in": "x", "out": "a", "event": "tick"}}, "tick<a")
    assert "operator could no longer control" in found(broken)["internal-impossible"].text


@pytest.mark.parametrize(
    "mended",
    [
        {"t": {"when": "k > 1"}, "u": {"when": "k <= 1"}},
        {"t": {"priority": 1}, "u": {}},
        {"t": {"weight": 1.0}, "u": {"weight": 2.0}},
    ],
    ids=["conditions", "priority", "weight"],
)
def test_what_decides_a_conflict(task: Tasks, mended: dict[str, dict[str, Any]]) -> None:
    net = {n: {"in": "x", "event": "e", **mended[n]} for n in ("t", "u")}
    assert "unsettled-conflict" not in found(task("x=1", net, "e", {"k": 0}))


def test_conditions_that_overlap_give_a_witness(task: Tasks) -> None:
    net = {
        "t": {"in": "x", "event": "e", "when": "k > 1"},
        "u": {"in": "x", "event": "e", "when": "k < 4"},
    }
    witness = found(task("x=1", net, "e", {"k": 0}))["unsettled-conflict"].witness
    assert 1 < witness["k"] < 4


def test_uncovered_outgoing_transition_gives_a_witness(task: Tasks) -> None:
    net = {**A, "n": {"in": "a:normal", "when": "k > 1"}, "m": {"in": "a:normal", "when": "k < 0"}}
    assert 0 <= found(task("a!=1 y", net, variables={"k": 0}))["uncovered-exit"].witness["k"] <= 1


@pytest.mark.parametrize(
    "net",
    [
        {"t": {"in": "x !y"}, "u": {"in": "x y"}},
        {"t": {"in": "a:normal x"}, "u": {"in": "a:error x"}},
        {"t": {"in": "a:normal x"}, "u": {"in": "a:preempt=none x", "event": "e"}},
    ],
    ids=["inhibitor", "status", "end and preemption"],
)
def test_tokens_that_exclude_each_other_are_no_conflict(
    task: Tasks, net: dict[str, dict[str, Any]]
) -> None:
    codes = found(task("x=1 y=1 a!=1", net, "e"))
    assert "unsettled-conflict" not in codes and "arrival-order" not in codes


def test_conflicts_of_a_long_task_are_found_soon(task: Tasks) -> None:
    """All pairs of transitions, and in each step all pairs of invariants, were compared: the cube
    of the length, 5 s for 400 steps."""

    def effort(steps: int) -> int:
        places = " ".join(f"a{n}! u{n}~=1" for n in range(steps))
        net = {
            f"{end}{n}": {"in": f"a{n}:{end} u{n}", "out": f"a{(n + 1) % steps} u{n}"}
            for n in range(steps)
            for end in ("normal", "error")
        }
        long = task(f"{places} c=1", net)
        assert long.net.transitions  # it is kept, and not counted
        return calls(lambda: list(conflicts(long)))

    assert effort(160) < 5 * effort(80)


@pytest.mark.parametrize(
    "lost",
    [
        {},
        {"lost": {"in": "q", "out": "c", "event": "g"}},
        {
            "lost": {"in": "q", "out": "c", "event": "g"},
            "seen": {"in": "c", "out": "c", "event": "g"},
        },
    ],
)
def test_invariant_that_excludes_two_transitions(
    task: Tasks, lost: dict[str, dict[str, Any]]
) -> None:
    """Also where a token can leave for a control place: it does not come back, even if another
    transition takes it and puts it back."""
    net = {
        **lost,
        "swap": {"in": "p", "out": "q", "event": "f"},
        "back": {"in": "q", "out": "p", "event": "f"},
        "t": {"in": "p r", "out": "p", "event": "e"},
        "u": {"in": "q r", "out": "q", "event": "e"},
    }
    pairs = [
        f.text
        for f in check(task("p~=1 q~ c r~=1", net, "e f g")).findings
        if f.code == "unsettled-conflict"
    ]
    assert pairs == []
    pairs = [
        f.text
        for f in check(task("p~=1 q~=1 c r~=1", net, "e f g")).findings
        if f.code == "unsettled-conflict"
    ]
    assert any(t.startswith("t and u") for t in pairs), "with two tokens they can meet"
    pairs = [
        f.text
        for f in check(task("p=1 q c r~=1", net, "e f g")).findings
        if f.code == "unsettled-conflict"
    ]
    assert any(t.startswith("t and u") for t in pairs), "the operator may add the second one"


@pytest.mark.parametrize(
    ("places", "net"),
    [
        ("x=1 k=3 y", {"t": {"in": "x k", "out": "x"}, "u": {"in": "x !k", "out": "y"}}),
        ("y", {"t": {"in": "!y*2", "out": "y"}}),
        # the run that it starts inhibits it
        ("a! x", {"t": {"in": "!x !a", "out": "a"}, "u": {"in": "a:normal", "out": "x"}}),
        (  # the lid is open, or it is not
            "x=1 a! lid",
            {"t": {"in": "x !lid", "out": "a"}, "u": {"in": "a:preempt=none lid", "out": "x lid"}},
        ),
        ("x=1 a! shut~=1 open~", DOOR),  # one of the two always bars
        # a circle without tokens
        ("x~ y~", {"t": {"in": "x", "out": "y"}, "u": {"in": "y", "out": "x"}}),
    ],
)
def test_a_loop_that_counts_or_bars_itself_is_no_timeless_cycle(
    places: str, net: dict[str, Any], task: Tasks
) -> None:
    assert "timeless-cycle" not in found(task(places, net))


@pytest.mark.parametrize(
    ("places", "more"),
    [
        ("x=1 a! shut=1 open", {}),  # the operator may empty both
        ("x=1 a! shut~ open~", {}),
        ("x=1 a! shut~=1 open~", {"lost": {"in": "open", "after": 1.0}}),
    ],
)
def test_a_loop_that_two_empty_places_permit_is_a_timeless_cycle(
    places: str, more: dict[str, Any], task: Tasks
) -> None:
    assert "timeless-cycle" in found(task(places, {**DOOR, **more}))


@pytest.mark.parametrize(
    ("change", "competes"),
    [
        ({}, False),
        ({"t": {"in": "x p", "out": "p*2"}}, False),
        ({"t": {"in": "x p"}}, True),
        ({"t": {"in": "x p*2", "out": "p"}}, True),
        ({"t": {"in": "x p", "out": "p z"}, "u": {"in": "y p !z", "out": "p"}}, True),
        *(  # the event is lost if the other is first
            (
                {
                    "t": {"in": "x p", "out": "p", "event": event},
                    "u": {"in": "y p", "out": "p", "event": event},
                },
                True,
            )
            for event in "ed"
        ),
        ({"t": {"in": "x p", "out": "p", "event": "k"}}, False),
    ],
)
def test_transitions_that_give_back_what_they_take_do_not_compete(
    change: dict[str, Any], competes: bool, task: Tasks
) -> None:
    """Unless the one that is first keeps the other from firing just after it."""
    net = {"t": {"in": "x p", "out": "p"}, "u": {"in": "y p", "out": "p"}, **change}
    codes = found(task("x~=1 y~=1 p~=2 z~", net, "e d* k+"))
    assert ("unsettled-conflict" in codes) == competes, codes


def test_places_that_wait_together_are_one_finding(task: Tasks) -> None:
    net = {
        "t": {"in": "x y a:normal", "event": "e"},
        "e": {"in": "a:error"},
        "u": {"in": "z", "event": "e"},
    }
    made = check(task("a!=1 x=1 y=1 z=1", net, "e*")).findings
    texts = {f.key: f.text for f in made if f.code == "external-wait"}
    assert set(texts) == {"places.a", "places.z"}
    assert texts["places.a"].startswith("only e can free the tokens of a:normal, x, y:")
    assert texts["places.z"].startswith("only e can free its token:")


@pytest.mark.parametrize(
    ("events", "told"),
    [
        ("e*", "if it never comes, or only too early, the task hangs"),
        ("e+", "if it never comes, the task hangs"),
    ],
)
def test_an_event_that_is_lost_if_it_comes_early_is_told(
    task: Tasks, events: str, told: str
) -> None:
    made = check(task("z=1", {"u": {"in": "z", "event": "e"}}, events)).findings
    (text,) = (f.text for f in made if f.code == "external-wait")
    assert text == f"only e can free its token: {told}"


def test_after_beside_an_external_wait(task: Tasks) -> None:
    net = {"t": {"in": "x", "event": "e"}, "late": {"in": "x", "after": 9.0}}
    assert "external-wait" not in found(task("x=1", net, "e"))


def test_events_wait_for_themselves_cover_all_cases(task: Tasks) -> None:
    net = {
        **A,
        "n": {"in": "a:normal", "event": "e", "when": "k > 1"},
        "late": {"in": "a:normal", "after": 3.0, "priority": 1},
    }
    assert "uncovered-exit" not in found(task("a!=1 y", net, "e*", {"k": 0}))


def test_action_that_no_node_offers(task: Tasks) -> None:
    made = task("a!=1 y", A, alternatives={"a": ("look_once", "look_twice")})
    finding = found(made, offers={"look_once": "vision", "look_twise": "vision"})["unoffered"]
    assert "'look_twice'" in finding.text and "did you mean 'look_twise'" in finding.text
    assert "unoffered" not in found(made, offers={"look_once": "vision", "look_twice": "vision"})
    assert "unoffered" not in found(made)
    assert (
        "to mine.toml, or"
        in found(made, offers={"look_once": "vision"}, source="mine.toml")["unoffered"].remedy
    )


@pytest.mark.parametrize(
    ("said", "finds"),
    [("look", False), ("take", False), ("lok", True), ("rest", True)],
)
def test_action_that_is_said_to_translate_another_primitive_task(
    task: Tasks, said: str, finds: bool
) -> None:
    net = {**A, "s": {"in": "b:normal", "out": "y"}, "f": {"in": "b:error", "out": "y"}}
    made = task("a!=1 b! y", net, alternatives={"a": ("move",), "b": ("move",)})
    both = dict(made.primitive_tasks)
    names = dict(zip(both, ("look", "take"), strict=True))
    renamed = {new: replace(both[old], name=new) for old, new in names.items()}
    renamed["rest"] = replace(renamed["look"], name="rest", alternatives=("stand",))
    places = {n: replace(p, task=names[p.task]) if p.task else p for n, p in made.places.items()}
    made = replace(made, primitive_tasks=renamed, places=places)
    report = check(made, {"move": "arm"}, translates={"move": said}, source="mine.toml")
    found = [f for f in report.findings if f.code == "translates-other"]
    assert bool(found) is finds and report.ok
    assert all(f.severity is W and f.key == "primitive_tasks.look.alternatives" for f in found)
    assert all(
        "mine.toml says" in f.text and repr(said) in f.text and "'look' or 'take'" in f.remedy
        for f in found
    )


def test_a_place_without_tokens_is_told_once_with_all_that_it_stops(task: Tasks) -> None:
    """A forgotten token of a resource gave one warning for each place and transition."""
    net = {
        "begin": {"in": "runs arm", "out": "a"},
        "n": {"in": "a:normal", "out": "arm"},
        "e": {"in": "a:error", "out": "arm broken"},
        "more": {"in": "lost", "out": "y"},
    }
    report = check(task("runs~=1 a! arm~ lost~ broken~ y", net))
    told = {f.key: f.text for f in report.findings if f.code == "never-marked"}
    assert told == {
        "places.lost": "it never holds a token; so more can never fire",
        "places.arm": "it never holds a token; so begin, e, n can never fire, and a, broken stay "
        "empty",
    }


def test_final_error_at_the_start(task: Tasks) -> None:
    made = task(
        "x=1 y",
        {"t": {"in": "x", "out": "y", "event": "e"}},
        "e",
        final="y == 1",
        final_error=parse("x == 1"),
    )
    assert found(made)["final-at-start"].key == "task.final_error"


NESTED = """schema = 1
[task]
name = "nested"
final = "parts == 0"
[primitive_tasks]
work = { deadline = 1.0 }
[places]
parts = { kind = "control", tokens = 1 }
one = { kind = "macro", subnet = "outer" }
two = { kind = "macro", subnet = "outer" }
never = { kind = "macro", subnet = "inner" }
[transitions]
start = { in = ["parts"], out = ["one"] }
next = { in = ["one:normal"], out = ["two"] }
done = { in = ["two:normal"] }
lost = { in = ["never:normal"] }
[subnets.outer]
entry = "begin"
normal = "end"
places = { begin = {}, part = { kind = "macro", subnet = "inner" }, end = {} }
[subnets.outer.transitions]
enter = { in = ["begin"], out = ["part"] }
leave = { in = ["part:normal"], out = ["end"] }
[subnets.inner]
entry = "begin"
normal = "end"
places = { begin = {}, work = { kind = "action" }, end = {} }
[subnets.inner.transitions]
enter = { in = ["begin"], out = ["work"] }
leave = { in = ["work:normal"], out = ["end"] }
"""


def test_a_finding_about_a_subnet_is_told_once_and_one_about_a_use_at_its_macro_place() -> None:
    found = {(f.code, f.key): f.remedy for f in check(loads(NESTED)).findings}
    remedy = found.pop(("no-error-exit", "subnets.inner.places.work"))
    assert 'add to [subnets.inner.transitions] one with in = ["work:error"]' in remedy
    assert "error = ... in [subnets.inner]" in remedy
    assert [*found] == [("never-marked", "places.never.begin")]
