"""Short forms of the task file: their expansion, their execution, and their faults."""

from __future__ import annotations

import pytest
from hypothesis import given, strategies as st

from petrobot.coordinator.engine import (
    AddTokens,
    Begin,
    CancelRun,
    Engine,
    EventOccurred,
    Finished,
    Fired,
    ForceExit,
    RunEnded,
    StartRun,
    StopConfirmed,
)
from petrobot.coordinator.task import Executed, Status, Task
from petrobot.coordinator.task.check import check
from petrobot.coordinator.task.file import TaskFileError, dumps, loads
from petrobot.coordinator.task.file.reading import write_arc
from tests.engine.conftest import Play

SHORT = """schema = 1
[task]
name = "tidy"
final = "parts == 0 and arm == 1"

[errors]
to = "aside"

[primitive_tasks.grasp]
goal = "the part is in the gripper"
alternatives = ["grasp"]
deadline = 5.0

[primitive_tasks.put]
goal = "the part is in the bin"
alternatives = ["put"]
deadline = 5.0

[variables.bin]
type = "str"
values = ["left", "right"]

[places.parts]
kind = "control"
tokens = 2

[places.arm]
kind = "resource"
tokens = 1

[places.grasp]
kind = "action"
task = "grasp"
timeout = 2.0
holds = ["arm"]

[places.in_hand]
holds = ["arm"]

[places.put]
kind = "macro"
subnet = "put"
args = { to = "done", where = { var = "bin" }, flag = "bin" }
holds = ["arm"]

[places.aside]

[places.done]

[transitions.next]
in = ["parts"]
out = ["grasp"]
set = { bin = "'left'" }

[transitions.grasped]
in = ["grasp:normal"]
out = ["in_hand"]

[transitions.carry]
in = ["in_hand"]
out = ["put"]

[transitions.placed]
in = ["put:normal"]

[transitions.counted]
in = ["done"]

[transitions.cleared]
in = ["aside"]

[subnets.put]
entry = "move"
normal = "over"
error = "failed"

[subnets.put.parameters]
to = "place"
where = "str"
flag = "variable"

[subnets.put.errors]
to = "failed"

[subnets.put.places.move]
kind = "action"
task = "put"
args = { bin = { var = "where" } }
out = { next = "flag" }

[subnets.put.places.over]

[subnets.put.places.failed]

[subnets.put.transitions.moved]
in = ["move:normal"]
out = ["over", "to"]
when = "where == 'left'"
"""


def arcs(task: Task) -> dict[str, str]:
    """The arcs of each transition of the flat task, in words."""
    return {
        t.name: " ".join([*map(write_arc, t.inputs), *map(write_arc, t.inhibitors)])
        + " -> "
        + " ".join(map(write_arc, t.outputs))
        for t in task.flat.transitions.values()
    }


def test_short_forms_expand_to_plain_net_elements() -> None:
    task = loads(SHORT)
    assert loads(dumps(task)) == task
    assert arcs(task) == {
        "put.moved": "put.move:normal -> put.over done",
        "next": "parts arm -> grasp",
        "grasped": "grasp:normal -> in_hand",
        "carry": "in_hand -> put.move",
        "placed": "put.over -> arm",
        "counted": "done -> ",
        "cleared": "aside -> ",
        "put.move.error": "put.move:error -> put.failed",
        "grasp.error": "grasp:error -> aside arm",
        "put.error": "put.failed -> aside arm",
    }
    flat = task.flat
    assert flat.flat is flat
    assert flat.places["put.move"].out == {"next": "bin"}
    when = flat.transitions["put.moved"].when
    assert when is not None and when.text == "bin == 'left'"
    assert flat.final.text == (
        "(parts == 0 and arm == 1) and in_hand == 0 and put.over == 0 and put.failed == 0"
        " and aside == 0 and done == 0"
    )
    assert {f.code for f in check(task).errors} == {"uncovered-exit"}  # bin may be 'right'


def test_a_subnet_takes_tokens_from_a_place_that_is_its_parameter() -> None:
    old, new = 'out = ["over", "to"]', 'out = ["over"]'
    text = SHORT.replace(old, new).replace('in = ["move:normal"]', 'in = ["move:normal", "to"]')
    assert arcs(loads(text))["put.moved"] == "put.move:normal done -> put.over"


def test_a_macro_place_holds_its_resource_once() -> None:
    """Two branches inside do not need the resource twice."""
    forked = (
        SHORT.replace('entry = "move"', 'entry = "begin"')
        + """
[subnets.put.places.begin]
[subnets.put.places.left]
[subnets.put.transitions.fork]
in = ["begin"]
out = ["move", "left"]
[subnets.put.transitions.quiet]
in = ["left"]
"""
    )
    found = arcs(loads(forked))
    assert found["put.fork"] == "put.begin -> put.move put.left"
    assert found["carry"] == "in_hand -> put.begin"
    assert found["placed"] == "put.over -> arm"


def test_the_entry_and_the_exits_of_a_subnet_hold_what_they_say() -> None:
    """Else `carry` enters a place that holds the hand without taking it."""
    nested = SHORT.replace(
        "[subnets.put.places.move]", "[subnets.put.places.move]\nholds = ['hand']"
    )
    nested = nested.replace(
        "[subnets.put.places.failed]", "[subnets.put.places.failed]\nholds = ['hand']"
    )
    nested += "[places.hand]\nkind = 'resource'\ntokens = 1\n"
    found = arcs(loads(nested))
    assert found["carry"] == "in_hand hand -> put.move"
    assert found["put.moved"] == "put.move:normal -> put.over done hand"
    assert found["put.move.error"] == "put.move:error -> put.failed"
    assert found["put.error"] == "put.failed -> aside arm hand"
    inner = """[subnets.put.places.deep]
kind = "macro"
subnet = "deep"
holds = ["arm"]
[subnets.deep]
entry = "begin"
normal = "end"
[subnets.deep.places.begin]
holds = ["hand"]
[subnets.deep.places.end]
[subnets.deep.transitions.only]
in = ["begin"]
out = ["end"]
[subnets.put.transitions.up]
in = ["deep:normal"]
out = ["move"]
"""
    found = arcs(loads(nested.replace('entry = "move"', 'entry = "deep"') + inner))
    assert found["carry"] == "in_hand arm hand -> put.deep.begin"
    assert found["put.deep.only"] == "put.deep.begin -> put.deep.end hand"
    assert found["put.up"] == "put.deep.end hand -> put.move arm"


def test_a_value_replaces_a_parameter() -> None:
    flat = loads(SHORT.replace('where = { var = "bin" }', 'where = "right"')).flat
    assert flat.places["put.move"].args == {"bin": "right"}
    when = flat.transitions["put.moved"].when
    assert when is not None and when.text == "'right' == 'left'"


TRIES = """schema = 1
[task]
name = "again"
final = "parts == 0"
goal_transitions = ["grasped"]

[primitive_tasks.grasp]
goal = "the part is in the gripper"
alternatives = ["grasp"]
deadline = 5.0

[places.parts]
kind = "control"
tokens = 3

[places.hand]
kind = "resource"
tokens = 1

[places.grasp]
kind = "action"
task = "grasp"
tries = 3
holds = ["hand"]

[events.enough]
scope = "external"

[transitions.next]
in = ["parts"]
out = ["grasp"]

[transitions.grasped]
in = ["grasp:normal"]

[transitions.dropped]
in = ["grasp:error"]

[transitions.stop]
in = ["grasp:preempt=none"]
event = "enough"
"""


def test_tries_are_counted_and_given_back() -> None:
    assert arcs(loads(TRIES)) == {
        "next": "parts hand -> grasp",
        "grasped": "grasp:normal !grasp.used -> hand",
        "dropped": "grasp:error !grasp.used -> hand",
        "stop": "grasp:preempt=none !grasp.used -> hand",
        "grasp.retry": "grasp:error grasp.left -> grasp.used grasp",
        "grasped.1": "grasp:normal grasp.used !grasp.used*2 -> hand grasp.left",
        "grasped.2": "grasp:normal grasp.used*2 -> hand grasp.left*2",
        "dropped.1": "grasp:error grasp.used !grasp.used*2 -> hand grasp.left",
        "dropped.2": "grasp:error grasp.used*2 -> hand grasp.left*2",
        "stop.1": "grasp:preempt=none grasp.used !grasp.used*2 -> hand grasp.left",
        "stop.2": "grasp:preempt=none grasp.used*2 -> hand grasp.left*2",
    }
    flat = loads(TRIES).flat
    assert flat.goal_transitions == ("grasped", "grasped.1", "grasped.2")
    assert {t.expanded_from for t in flat.transitions.values()} == {
        "",
        "grasp",
        "grasped",
        "dropped",
        "stop",
    }
    assert not check(loads(TRIES)).errors


ENDS = st.sampled_from(
    [
        (Status.SUCCESS, "", Executed.YES),
        (Status.FAILURE, "", Executed.YES),
        (Status.ERROR, "slipped", Executed.YES),
        (Status.ERROR, "slipped", Executed.NO),
        (Status.ERROR, "node_lost", Executed.UNKNOWN),
        (Status.ERROR, "emergency_stop", Executed.NO),
        None,  # the event comes: the run is preempted
    ]
)


@given(st.lists(ENDS, min_size=30, max_size=30), st.booleans())
def test_each_token_has_its_tries(
    ends: list[tuple[Status, str, Executed] | None], retry_unknown: bool
) -> None:
    """Only an ERROR that is not an emergency stop, and after which `executed` is known, leads to
    another run."""
    text = TRIES.replace("tries = 3", "tries = 3\nretry_unknown = true") if retry_unknown else TRIES
    play = Play(Engine(loads(text)))
    play(Begin())
    remaining = list(ends)
    left = dict(zip(play.engine.compiled.net.places, play.state.marking, strict=True))
    assert left["grasp"] == 1
    for _ in range(3):
        for used in range(3):
            (run,) = play.state.tokens["grasp"]
            end = remaining.pop()
            if end is None:
                play(EventOccurred("enough"), StopConfirmed(run.id, Executed.YES))
                break
            came = play(RunEnded(run.id, end[0], end[1], executed=end[2]))
            again = (
                end[0] is Status.ERROR
                and end[1] != "emergency_stop"
                and (retry_unknown or end[2] is not Executed.UNKNOWN)
                and used < 2
            )
            fired = [i.transition for i in came if isinstance(i, Fired)]
            assert ("grasp.retry" in fired) is again
            if not again:
                break
    assert isinstance(play.all[-1], Finished) and play.all[-1].status is Status.SUCCESS
    left = dict(zip(play.engine.compiled.net.places, play.state.marking, strict=True))
    assert (left["grasp.left"], left["grasp.used"], left["hand"]) == (2, 0, 1)


def test_an_added_error_branch_is_forced_whatever_tries_are_used() -> None:
    """The operator names `grasp.error`; its copies are for the tries used."""
    dropped = '[transitions.dropped]\nin = ["grasp:error"]\n'
    play = Play(Engine(loads(TRIES.replace(dropped, "") + '[errors]\nto = "parts"\n')))
    play(Begin(), RunEnded("grasp#1", Status.ERROR), ForceExit("grasp.error"))
    assert play.fired[-2:] == ["grasp.error.1", "next"]


def test_a_timeout_is_a_shorter_deadline() -> None:
    play = Play(Engine(loads(SHORT)))
    (start,) = (i for i in play(Begin()) if isinstance(i, StartRun))
    assert (start.place, start.deadline) == ("grasp", 2.0)


LISTEN = """schema = 1
[task]
name = "listening"
final = "parts == 0"

[primitive_tasks.work]
goal = "done"
alternatives = ["work"]
deadline = 5.0

[places.parts]
kind = "control"
tokens = 1

[places.work]
kind = "action"
task = "work"

[places.button]
kind = "action"
task = "work"
tokens = 1
listen = true

[places.ready]
tokens = 1
listen = true

[transitions.next]
in = ["parts"]
out = ["work"]

[transitions.done]
in = ["work:normal"]

[transitions.failed]
in = ["work:error"]

[transitions.pressed]
in = ["button:normal"]
out = ["button"]

[transitions.broken]
in = ["button:error"]
out = ["button"]
"""


def test_listening_runs_are_stopped_when_the_task_ends() -> None:
    play = Play(Engine(loads(LISTEN)))
    play(Begin(), RunEnded("button#1", Status.SUCCESS))
    answer = play(RunEnded("work#1", Status.SUCCESS))
    assert [i.run for i in answer if isinstance(i, CancelRun)] == ["button#2"]
    assert not any(isinstance(i, Finished) for i in answer), "its run has not stopped yet"
    refused = play(AddTokens("parts", 1))
    assert [type(i).__name__ for i in refused] == ["Report"]
    (end,) = (i for i in play(StopConfirmed("button#2", Executed.YES)) if isinstance(i, Finished))
    assert end.status is Status.SUCCESS


def test_a_run_that_does_not_listen_keeps_the_task_open() -> None:
    play = Play(Engine(loads(LISTEN.replace("listen = true\n\n[places.ready]", "[places.ready]"))))
    play(Begin(), RunEnded("work#1", Status.SUCCESS))
    assert not any(isinstance(i, Finished) for i in play.all)


SETS = """schema = 1
[task]
name = "sets"
final = "done == 4"

[task.parameters]
first = "left"

[primitive_tasks.go]
goal = "there"
alternatives = ["go"]
deadline = 5.0

[variables.bin]
type = "str"
initial = "none yet"

[variables.count]
type = "int"
initial = 0

[places.left]
kind = "control"
tokens = 2

[places.right]
kind = "control"
tokens = 1

[places.done]

[places.go]
kind = "action"
task = "go"
servers = 1
args = { to = { var = "bin" }, n = { var = "count" } }

[transitions.to_left]
in = ["left"]
out = ["go"]
set = { bin = "first", count = 1 }

[transitions.to_right]
in = ["right"]
out = ["go"]
set = { bin = "'right'", count = 2 }

[transitions.arrived]
in = ["go:normal"]
out = ["done"]

[transitions.lost]
in = ["go:error"]
out = ["done"]
"""


def test_a_firing_sets_variables_and_its_token_keeps_them() -> None:
    """Three tokens wait for one server; each run gets the values from when its token entered. Two
    transitions that set one variable do not fire in one step."""
    play = Play(Engine(loads(SETS)))
    play(Begin())
    order = [i.transition for i in play.all if isinstance(i, Fired)]
    assert sorted(order) == ["to_left", "to_left", "to_right"]
    for n in (1, 2, 3):
        play(RunEnded(f"go#{n}", Status.SUCCESS))
    given = [dict(i.arguments) for i in play.all if isinstance(i, StartRun)]
    expected = {"to_left": {"to": "left", "n": 1}, "to_right": {"to": "right", "n": 2}}
    assert given == [expected[name] for name in order]
    assert play.state.variables["bin"] == expected[order[-1]]["to"]


def test_conditions_of_the_same_step_read_the_old_value() -> None:
    text = SETS.replace(
        "[transitions.arrived]",
        '[transitions.watch]\nin = ["watching"]\nwhen = "count == 0"\n\n[transitions.arrived]',
    ).replace("[places.done]", "[places.watching]\ntokens = 1\n\n[places.done]")
    play = Play(Engine(loads(text)))
    play(Begin())
    fired = [i.transition for i in play.all if isinstance(i, Fired)]
    assert "watch" in fired[:2], "it fires in the first step, before count is set"


@pytest.mark.parametrize(
    ("text", "old", "new", "key", "words"),
    [
        (
            SHORT,
            "[places.in_hand]",
            '[places.in_hand]\ntask = "put"',
            "places.in_hand.kind",
            'kind = "action"',
        ),
        (
            SHORT,
            "[places.in_hand]",
            '[places.in_hand]\nsubnet = "put"',
            "places.in_hand.kind",
            'kind = "macro"',
        ),
        (
            SHORT,
            "[places.in_hand]",
            "[places.in_hand]\ntries = 2",
            "places.in_hand.tries",
            "runs no action",
        ),
        (
            SHORT,
            "[places.in_hand]",
            "[places.in_hand]\ntimeout = 2.0",
            "places.in_hand.timeout",
            "runs no action",
        ),
        (SHORT, "timeout = 2.0", "timeout = 0.0", "places.grasp.timeout", "positive"),
        (
            SHORT,
            "timeout = 2.0",
            "timeout = 9.0",
            "places.grasp.timeout",
            "longer than the deadline",
        ),
        (SHORT, "timeout = 2.0", "tries = 0", "places.grasp.tries", "1 or more"),
        (SHORT, "timeout = 2.0", "tries = 2\nservers = 2", "places.grasp.tries", "drop `servers`"),
        (SHORT, "timeout = 2.0", "tries = 5000", "places.grasp.tries", "at most 100"),
        (
            SHORT,
            "[places.in_hand]",
            '[places.a]\nkind = "action"\ntask = "put"\ntries = 40\n\n'
            '[places.b]\nkind = "action"\ntask = "put"\ntries = 40\n\n'
            '[transitions.both]\nin = ["a:normal", "b:normal"]\n\n[places.in_hand]',
            "transitions.both",
            "1600 cases of it",
        ),
        (
            SHORT,
            "timeout = 2.0",
            "retry_unknown = true",
            "places.grasp.retry_unknown",
            "give `tries`",
        ),
        (
            SHORT,
            'kind = "resource"',
            'kind = "resource"\nlisten = true',
            "places.arm.listen",
            "listens to nothing",
        ),
        (
            SHORT,
            'kind = "control"',
            'kind = "control"\nholds = ["arm"]',
            "places.parts.holds",
            "holds nothing",
        ),
        (
            SHORT,
            '[places.in_hand]\nholds = ["arm"]',
            '[places.in_hand]\nholds = ["arms"]',
            "places.in_hand.holds",
            "did you mean 'arm'",
        ),
        (
            SHORT,
            '[places.in_hand]\nholds = ["arm"]',
            '[places.in_hand]\nholds = ["parts"]',
            "places.in_hand.holds",
            "is not a resource",
        ),
        (
            SHORT,
            'in = ["parts"]',
            'in = ["parts", "arm"]',
            "transitions.next.in",
            "`holds` makes it",
        ),
        (
            SHORT,
            '[errors]\nto = "aside"',
            '[errors]\nto = "asid"',
            "errors.to",
            "did you mean 'aside'",
        ),
        (SHORT, '[errors]\nto = "aside"', '[errors]\nto = "grasp"', "errors.to", "lead nowhere"),
        (SHORT, '[errors]\nto = "aside"', "[errors]", "errors.to", "missing"),
        (
            SHORT,
            "bin = \"'left'\"",
            'bin = "left"',
            "transitions.next.set.bin",
            "texts stand in quotes",
        ),
        (
            SHORT,
            "bin = \"'left'\"",
            'bin = "1 == 2"',
            "transitions.next.set.bin",
            "neither a literal nor a name",
        ),
        (SHORT, "bin = \"'left'\"", "bin = 3", "transitions.next.set.bin", "not of type str"),
        (
            SHORT,
            "bin = \"'left'\"",
            "bin = \"'up'\"",
            "transitions.next.set.bin",
            "write one of \"'left'\", \"'right'\"",
        ),
        (
            SHORT,
            "bin = \"'left'\"",
            "bim = \"'left'\"",
            "transitions.next.set.bim",
            "did you mean 'bin'",
        ),
        (SHORT, 'to = "done", ', "", "places.put.args", "'to' is missing"),
        (SHORT, 'to = "done"', 'to = "dome"', "places.put.args.to", "did you mean 'done'"),
        (SHORT, 'to = "done"', 'to = "done", by = 1', "places.put.args.by", "no such parameter"),
        (SHORT, 'flag = "bin"', 'flag = "bim"', "places.put.args.flag", "did you mean 'bin'"),
        (SHORT, 'where = { var = "bin" }', "where = 3", "places.put.args.where", "not of type str"),
        (SHORT, 'where = "str"', 'where = "text"', "subnets.put.parameters.where", "none of"),
        (
            SHORT,
            'where = "str"',
            'where = "str"\nbin = "str"',
            "subnets.put.parameters.bin",
            "rename",
        ),
    ],
)
def test_faults_name_key_and_remedy(text: str, old: str, new: str, key: str, words: str) -> None:
    assert old in text
    changed = text.replace(old, new, 1)
    with pytest.raises(TaskFileError) as error:
        loads(changed)
    assert any(f.key == key for f in error.value.faults), [str(f) for f in error.value.faults]
    assert words in str(error.value)


@pytest.mark.parametrize("text", [SHORT, TRIES])
def test_a_flat_task_can_be_written_and_read(text: str) -> None:
    """As in a journal: with the origin of each element, and without short forms."""
    flat = loads(text).flat
    again = loads(dumps(flat), flat=True)
    assert again == flat and again.flat is again and again.net == flat.net
    with pytest.raises(TaskFileError, match=r"expanded_from|cannot be a name"):
        loads(dumps(flat))
