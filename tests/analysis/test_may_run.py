"""Findings that need the state space: each names the line that is to be mended, and how."""

from __future__ import annotations

import pytest

from petrobot.coordinator.analysis.may_run import LEFT_RUNNING, Budget, may_run
from petrobot.coordinator.task.check import Finding
from petrobot.coordinator.task.file import loads

FORK = """schema = 1
[task]
name = "fork"
goal = "Each part is weighed while it is driven"
final = "parts == 0"
final_error = "broken > 0"
[errors]
to = "broken"
[primitive_tasks]
drive = { deadline = 5.0 }
weigh = { deadline = 5.0 }
[events]
button = {}
[places]
parts = { kind = "control", tokens = 2 }
base = { kind = "resource", tokens = 1 }
hurt = { holds = "base" }
broken = {}
there = { kind = "macro", subnet = "carry", holds = "base" }
back = { kind = "macro", subnet = "carry", holds = "base" }
[transitions]
start = { in = ["parts"], out = ["there"] }
turn = { in = ["there:normal"], out = ["back"] }
done = { in = ["back:normal"] }
lost = { in = ["there:error"], out = ["hurt"] }
gone = { in = ["back:error"], out = ["hurt"] }
again = { in = ["hurt"] }
[subnets.carry]
entry = "begin"
normal = "over"
error = "failed"
[subnets.carry.places]
begin = {}
drive = { kind = "action" }
weigh = { kind = "action" }
over = {}
failed = {}
[subnets.carry.transitions]
split = { in = ["begin"], out = ["drive", "weigh"] }
arrived = { in = ["drive:normal", "weigh:preempt=success"], out = ["over"] }
stopped = { in = ["weigh:normal", "drive:preempt=none"], out = ["failed"] }
stuck = { in = ["drive:error", "weigh:preempt=none"], out = ["failed"] }
dropped = { in = ["weigh:error", "drive:preempt=none"], out = ["failed"] }
"""
DROPPED = 'dropped = { in = ["weigh:error", "drive:preempt=none"], out = ["failed"] }\n'
STUCK = 'stuck = { in = ["drive:error", "weigh:preempt=none"], out = ["failed"] }\n'
FLAT = (
    (
        FORK.partition("there = {")[0]
        + """drive = { kind = "action" }
weigh = { kind = "action" }
[transitions]
split = { in = ["parts", "base"], out = ["drive", "weigh"] }
arrived = { in = ["drive:normal", "weigh:preempt=success"], out = ["base"] }
stopped = { in = ["weigh:normal", "drive:preempt=none"], out = ["hurt"] }
stuck = { in = ["drive:error", "weigh:preempt=none"], out = ["hurt"] }
again = { in = ["hurt"], out = ["base"] }
"""
    )
    .replace('hurt = { holds = "base" }', "hurt = {}")
    .replace('to = "broken"', 'to = "hurt"')
    .replace('final_error = "broken > 0"\n', "")
)
LISTENS = "listening = { tokens = 1 }\nhush = { listen = true }\n[transitions]\n"
PRESSED = 'pressed = { in = ["listening"], event = "button", out = ["hush"] }\n'
PRESSED += 'heard = { in = ["hush"], after = 1.0, out = ["listening"] }\n'


DEEP = """[subnets.deep]
entry = "run"
normal = "ok"
error = "bad"
[subnets.deep.places]
run = { kind = "action", task = "drive" }
ok = {}
bad = {}
[subnets.deep.transitions]
over = { in = ["run:normal"], out = ["ok"] }
"""
INNER = FORK.replace(DROPPED, "").replace(', "drive:preempt=none"', "") + DEEP
INNER = INNER.replace('drive = { kind = "action" }', 'drive = { kind = "macro", subnet = "deep" }')


def found(text: str, code: str) -> list[Finding]:
    report = may_run(loads(text), None, Budget()).report
    return [one for one in report.findings if one.code == code]


@pytest.mark.parametrize(
    ("text", "key", "told", "remedy"),
    [
        (
            FORK.replace(DROPPED, ""),
            "subnets.carry.places.weigh",
            "weigh.error, which was added because no transition has weigh:error, leaves drive",
            'add to [subnets.carry.transitions] one with in = ["weigh:error", '
            '"drive:preempt=none"], out = ["failed"]',
        ),
        (
            FORK.replace(DROPPED, "").replace(STUCK, ""),
            "subnets.carry.places.drive",
            "leaves weigh running",
            'in = ["drive:error", "weigh:preempt=none"]',
        ),
        (
            FORK.replace(STUCK, STUCK.replace(', "weigh:preempt=none"', "")),
            "subnets.carry.transitions.stuck.in",
            "leaves weigh running",
            'add "weigh:preempt=none"',
        ),
        (
            FLAT,
            "places.weigh",
            "weigh.error, which was added because no transition has weigh:error, leaves drive",
            'add to [transitions] one with in = ["weigh:error", "drive:preempt=none"], '
            'out = ["hurt"]',
        ),
        (
            FLAT.replace('weigh = { kind = "action" }', 'weigh = { kind = "action", tries = 3 }'),
            "places.weigh",
            "weigh.error, which was added",
            'in = ["weigh:error", "drive:preempt=none"]',
        ),
        (
            INNER,
            "subnets.carry.transitions.stopped.in",
            "leaves drive.run running",
            "let one take an exit of drive too: no macro place is preempted",
        ),
    ],
    ids=["one forgotten", "two", "written, without its partner", "no subnet", "tries", "deeper"],
)
def test_an_exit_that_leaves_the_other_branch_running_is_named(
    text: str, key: str, told: str, remedy: str
) -> None:
    """Not only the place that is entered twice much later."""
    first, *_ = found(text, LEFT_RUNNING)
    assert (first.key, told in first.text) == (key, True) and remedy in first.remedy, first


@pytest.mark.parametrize(
    "text",
    [FORK, FLAT + DROPPED.replace("failed", "hurt")],
    ids=["in a subnet", "without a subnet"],
)
def test_with_that_remedy_the_task_may_run(text: str) -> None:
    answer = may_run(loads(text), None, Budget())
    assert answer.ok and not found(text, LEFT_RUNNING), answer.report


@pytest.mark.parametrize(
    ("listen", "told"), [("tokens = 1", 1), ("tokens = 1, listen = true", 0)], ids=["no", "yes"]
)
def test_an_end_that_waits_for_an_event_is_noted(listen: str, told: int) -> None:
    """A place that must be empty at the end because it does not listen."""
    text = FORK.replace("[transitions]\n", LISTENS.replace("tokens = 1", listen) + PRESSED, 1)
    notes = found(text, "awaited-end")
    assert [(one.key, "button" in one.text) for one in notes] == [("places.listening", True)] * told
    assert all("listen = true" in one.remedy for one in notes)


@pytest.mark.parametrize(
    ("lost", "tokens", "told"),
    [
        (', out = ["lost"]', 0, "lost: filled by `slipped`, and no transition takes it"),
        ("", 1, "lost: from the beginning, and no transition takes it"),
    ],
    ids=["filled", "from the beginning"],
)
def test_a_place_that_nothing_empties_does_not_wait_for_an_event(
    lost: str, tokens: int, told: str
) -> None:
    """The note said "the end needs the event none", where another branch waits for one."""
    text = f"""
schema = 1
[task]
name = "loose"
final = "parts == 0"
[events]
button = {{ memory = "latched", early = "keep" }}
[primitive_tasks]
grip = {{ deadline = 2.0 }}
[places]
parts = {{ kind = "control", tokens = 2 }}
grip = {{ kind = "action" }}
lost = {{ tokens = {tokens} }}
waiting = {{ tokens = 1, listen = true }}
[transitions]
next = {{ in = ["parts", "!grip"], out = ["grip"] }}
gripped = {{ in = ["grip:normal"] }}
slipped = {{ in = ["grip:error"]{lost} }}
pressed = {{ in = ["waiting"], out = ["waiting"], event = "button" }}
"""
    assert not found(text, "awaited-end")
    analysis = may_run(loads(text), None, Budget()).analysis
    assert analysis is not None
    sound = analysis.verdicts()["sound"]
    assert not sound.holds and told in sound.details, sound
