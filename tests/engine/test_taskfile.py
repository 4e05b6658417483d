"""Task files: every fault has its line, key and remedy; the notation of arcs; subnets."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from petrobot.coordinator.task import Counts, End, Inhibitor, Input, Output
from petrobot.coordinator.task.check import check
from petrobot.coordinator.task.file import TaskFileError, dumps, load, loads
from petrobot.coordinator.task.file.reading import ArcError, read_input, read_output, write_arc

GOOD = """schema = 1

[task]
name = "small"
final = "done == 1"
runs_place = "runs"

[task.parameters]
seed = 1

[primitive_tasks.look]
goal = "it is seen"
alternatives = ["look_once", "look_twice"]
deadline = 2.0

[variables.seen]
type = "bool"

[events.tick]
scope = "external"

[places.runs]
kind = "control"
tokens = 1

[places.look]
kind = "action"
task = "look"
args = { seed = { var = "seed" } }
out = { seen = "seen" }

[places.done]
kind = "resource"

[transitions.start]
in = ["runs"]
out = ["look"]
event = "tick"

[transitions.found]
in = ["look:normal"]
out = ["done"]
when = "seen"
"""


def test_good_file_reads() -> None:
    task = loads(GOOD)
    assert task.net.transitions == ("start", "found") and task.flat is task
    assert loads(dumps(task)) == task


@pytest.mark.parametrize("initial", ["''", "'seen'", "0", "false", "0.0"])
def test_an_initial_value_is_written_also_if_it_is_empty(initial: str) -> None:
    """A journal has the task as it is written: a replay with another value of the variable would
    differ from the run."""
    kind = {"f": "bool", "0": "float" if "." in initial else "int"}.get(initial[0], "str")
    changed = f'type = "{kind}"\ninitial = {initial}'
    task = loads(GOOD.replace('type = "bool"', changed).replace('when = "seen"', ""))
    assert loads(dumps(task)) == task and task.variables["seen"].initial is not None


@pytest.mark.parametrize(
    ("written", "short"),
    [
        ('alternatives = ["look"]\n', ""),
        ('kind = "action"\ntask = "look"\n', 'kind = "action"\n'),
        ('scope = "external"\n', 'text = ""\n'),
        ('scope = "internal"\nby = "look"\n', 'by = "look"\n'),
        ('goal = ""\n', ""),
    ],
)
def test_what_a_name_says_already_may_be_left_out(written: str, short: str) -> None:
    """Also of an event whose `by` names who raises it."""
    text = GOOD.replace('alternatives = ["look_once", "look_twice"]', 'alternatives = ["look"]')
    if "goal" in written:
        text = text.replace('goal = "it is seen"', 'goal = ""')
    if "internal" in written:
        text = text.replace('scope = "external"', 'scope = "internal"\nby = "look"')
    assert text.count(written) == 1
    assert loads(text.replace(written, short)) == loads(text)


def test_a_place_that_is_named_like_no_primitive_task_must_name_one() -> None:
    text = (
        GOOD.replace('task = "look"\n', "").replace("look:", "see:").replace('["look"]', '["see"]')
    )
    with pytest.raises(TaskFileError, match=r":26: places.see.task: unknown .*'see'; write task ="):
        loads(text.replace("[places.look]", "[places.see]"))


@pytest.mark.parametrize(
    ("old", "new", "where", "words"),
    [
        ("schema = 1", "schema = 2", "schema", "write schema = 1"),
        ('name = "small"', "name = 3", "task.name", "not a text"),
        ('final = "done == 1"', "", "task.final", "missing"),
        ('final = "done == 1"', 'final = ""', "task.final", "empty condition"),
        ('final = "done == 1"', 'final = "dome == 1"', "task.final", "did you mean 'done'"),
        ('final = "done == 1"', 'final = "done = 1"', "task.final", "written =="),
        (
            'runs_place = "runs"',
            'runs_place = "done"',
            "task.runs_place",
            "expected a control place",
        ),
        (
            'runs_place = "runs"',
            'run_place = "runs"',
            "task.run_place",
            "did you mean 'runs_place'",
        ),
        ("[task.parameters]", "[task.parametres]", "task.parametres", "unknown key"),
        ("[events.tick]", "[event.tick]", "event", "did you mean 'events'"),
        ("deadline = 2.0", 'deadline = "2"', "primitive_tasks.look.deadline", "not a number"),
        ("deadline = 2.0", "deadline = nan", "primitive_tasks.look.deadline", "finite"),
        ("deadline = 2.0", "deadline = -1", "primitive_tasks.look.deadline", "positive"),
        ("deadline = 2.0", "deadline = true", "primitive_tasks.look.deadline", "not a number"),
        (
            "deadline = 2.0",
            'deadline = 2.0\ncost = "money"',
            "primitive_tasks.look.cost",
            "wall, cpu, count or value:NAME",
        ),
        (
            "deadline = 2.0",
            "deadline = 2.0\ncosts = { look_thrice = 2 }",
            "primitive_tasks.look.costs.look_thrice",
            "its alternatives are look_once",
        ),
        (
            "deadline = 2.0",
            "deadline = 2.0\ncosts = { look_once = -2 }",
            "primitive_tasks.look.costs.look_once",
            "at least 0",
        ),
        (
            "deadline = 2.0",
            "deadline = 2.0\ntarget_reliability = 2",
            "primitive_tasks.look.target_reliability",
            "0 < R <= 1",
        ),
        (
            '["look_once", "look_twice"]',
            "[]",
            "primitive_tasks.look.alternatives",
            "at least one action",
        ),
        (
            '["look_once", "look_twice"]',
            '["a", "a"]',
            "primitive_tasks.look.alternatives",
            "2 times",
        ),
        (
            '["look_once", "look_twice"]',
            "[1]",
            "primitive_tasks.look.alternatives",
            "expected a text",
        ),
        ('type = "bool"', 'type = "boolean"', "variables.seen.type", "did you mean 'bool'"),
        ('type = "bool"', 'type = "bool"\ninitial = 1', "variables.seen.initial", "expected bool"),
        (
            'type = "bool"',
            'type = "bool"\nvalues = ["a"]',
            "variables.seen.values",
            "make the type str",
        ),
        ('scope = "external"', 'scope = "internal"', "events.tick.by", "missing, as the event is"),
        (
            'scope = "external"',
            'scope = "external"\nearly = "keep"',
            "events.tick.early",
            "only a latched",
        ),
        ('scope = "external"', 'scope = "external"\nby = "look"', "events.tick.by", "drop `by`"),
        ('kind = "control"', 'kind = "controll"', "places.runs.kind", "did you mean 'control'"),
        ("tokens = 1", "tokens = -1", "places.runs.tokens", "0 or more"),
        ("tokens = 1", "tokens = 1.5", "places.runs.tokens", "whole number"),
        ("tokens = 1", "tokens = 3\ncapacity = 2", "places.runs.capacity", "raise it"),
        ("tokens = 1", 'tokens = 1\ntask = "look"', "places.runs", "cannot run an action"),
        ('task = "look"', 'task = "lok"', "places.look.task", "did you mean 'look'"),
        ('task = "look"', 'task = "look"\nservers = 0', "places.look.servers", "1 or more"),
        ('{ var = "seed" }', '{ var = "sed" }', "places.look.args.seed", "did you mean 'seed'"),
        ('{ var = "seed" }', "2020-01-01", "places.look.args.seed", "expected plain data"),
        (
            'out = { seen = "seen" }',
            'out = { seen = "saw" }',
            "places.look.out.seen",
            "unknown variable",
        ),
        ('in = ["runs"]', 'in = ["run"]', "transitions.start.in", "did you mean 'runs'"),
        ('in = ["runs"]', 'in = ["runs*0"]', "transitions.start.in", "1 or more"),
        ('in = ["runs"]', 'in = ["runs", "runs"]', "transitions.start.in", "runs*2"),
        ('in = ["runs"]', 'in = ["runs:normal"]', "transitions.start.in", "write runs alone"),
        ('in = ["runs"]', 'in = "runs"', "transitions.start.in", "not a list"),
        ('["look:normal"]', '["look"]', "transitions.found.in", "write look:normal, look:error"),
        ('["look:normal"]', '["look:norml"]', "transitions.found.in", "did you mean 'normal'"),
        ('["look:normal"]', '["look:preempt"]', "transitions.found.in", "=success, =failure"),
        (
            '["look:normal"]',
            '["look:normal=success"]',
            "transitions.found.in",
            "only a preempted run",
        ),
        ('["look:normal"]', '["look:normal*2"]', "transitions.found.in", "`servers`"),
        ('["look:normal"]', '["!look:normal"]', "transitions.found.in", "write !look"),
        ('["look:normal"]', '["look normal"]', "transitions.found.in", "is not an arc"),
        ('out = ["done"]', 'out = ["!done"]', "transitions.found.out", "not an arc of `out`"),
        ('event = "tick"', 'event = "tock"', "transitions.start.event", "unknown event"),
        ('event = "tick"', 'event = ["tick", "tick"]', "transitions.start.event", "twice"),
        (
            'event = "tick"',
            'event = "tick"\nafter = 1',
            "transitions.start.after",
            "beside this one",
        ),
        ('event = "tick"', "after = 0", "transitions.start.after", "positive"),
        ('event = "tick"', "weight = 0", "transitions.start.weight", "positive"),
        ('when = "seen"', 'when = "sen"', "transitions.found.when", "did you mean 'seen'"),
        ('when = "seen"', 'when = "look.status == 1"', "transitions.found.when", "never equal"),
        ('when = "seen"', 'when = ""', "transitions.found.when", "empty condition"),
        ("[places.done]", "[places.found]", "transitions.found", "a place has this name too"),
        ("seed = 1", "seen = 1", "variables.seen", "a parameter has this name too"),
        ("[places.done]", '[places."do ne"]', "places.do ne", "cannot be a name"),
    ],
)
def test_every_fault_is_named(old: str, new: str, where: str, words: str) -> None:
    assert old in GOOD
    text = GOOD.replace(old, new, 1)
    with pytest.raises(TaskFileError) as caught:
        loads(text, "small.toml")
    about = [str(f) for f in caught.value.faults if f.key == where]
    assert any(words in f for f in about), str(caught.value)
    assert str(caught.value).startswith("small.toml")


def test_pulse_plus_pulse_is_refused() -> None:
    text = GOOD.replace("[events.tick]", '[events.tock]\nscope = "external"\n\n[events.tick]')
    text = text.replace('event = "tick"', 'event = ["tick", "tock"]')
    with pytest.raises(TaskFileError, match="two pulses never come together"):
        loads(text)


def test_all_faults_come_at_once_with_their_lines() -> None:
    text = (
        GOOD.replace("deadline = 2.0", "deadline = 0")
        .replace("tokens = 1", "tokens = -1")
        .replace("look:normal", "lok:normal")
    )
    with pytest.raises(TaskFileError) as caught:
        loads(text, "small.toml")
    lines = dict(zip([f.key for f in caught.value.faults], caught.value.lines, strict=True))
    numbered = text.splitlines()
    assert numbered[lines["primitive_tasks.look.deadline"] - 1] == "deadline = 0"
    assert numbered[lines["places.runs.tokens"] - 1] == "tokens = -1"
    assert numbered[lines["transitions.found.in"] - 1] == 'in = ["lok:normal"]'


@pytest.mark.parametrize(
    ("text", "key", "line"),
    [
        (GOOD.replace("[events.tick]", "[event.tick]"), "event", "[event.tick]"),
        (
            GOOD.replace("[task.parameters]", "[task.parametres]"),
            "task.parametres",
            "[task.parametres]",
        ),
        (GOOD.replace("[events.tick]", "[[events.tick]]"), "events.tick", "[[events.tick]]"),
        (GOOD.replace("schema = 1", "schema = 2"), "schema", "schema = 2"),
        ("# nothing\nschema = 1\n", "task.name", "# nothing"),
        ("schema = 1\nplaces = 3\n[task]\n", "places", "places = 3"),
        ("schema = 1\nevent.tick.scope = 'x'\n", "event", "event.tick.scope = 'x'"),
    ],
)
def test_faults_of_whole_tables_have_lines(text: str, key: str, line: str) -> None:
    with pytest.raises(TaskFileError) as caught:
        loads(text)
    lines = dict(zip([f.key for f in caught.value.faults], caught.value.lines, strict=True))
    assert text.splitlines()[lines[key] - 1] == line


def test_broken_toml_says_where() -> None:
    with pytest.raises(TaskFileError, match=r"x\.toml:2: not valid TOML: Invalid value"):
        loads("schema = 1\nname = = 2\n", "x.toml")
    with pytest.raises(TaskFileError, match=r"x\.toml:2: not valid TOML: .*end of document"):
        loads("schema = 1\nname = ", "x.toml")


@pytest.mark.parametrize("data", [b"\xff\xfe", b"schema = 1\n# \xff"])
def test_a_file_that_is_not_text(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "task.toml"
    path.write_bytes(data)
    with pytest.raises(TaskFileError, match="UTF-8"):
        load(path)


def test_a_fault_of_a_huge_value_is_shortened() -> None:
    with pytest.raises(TaskFileError) as fault:
        loads(f'schema = "{"x" * 10**6}"', "huge.toml")
    assert all(len(line) < 2_000 for line in str(fault.value).splitlines())
    assert "huge.toml:1: schema: 'xx" in str(fault.value)


def test_a_word_that_is_like_no_other_has_a_remedy() -> None:
    with pytest.raises(TaskFileError, match=r"a.kind: '' is none of .*; write one of these"):
        loads('schema = 1\n[places]\na = { kind = "" }\n', "odd.toml")


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(TaskFileError, match="cannot be read"):
        load(tmp_path / "none.toml")
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(TaskFileError, match=r"Is a directory.*its permissions$"):
        load(tmp_path / "folder.toml")


@pytest.mark.parametrize(
    ("text", "arc"),
    [
        ("runs", Input("runs")),
        ("runs*2", Input("runs", 2)),
        (" runs * 3 ", Input("runs", 3)),
        ("a:normal", Input("a", 1, End.NORMAL)),
        ("a:error*2", Input("a", 2, End.ERROR)),
        ("a:preempt=none", Input("a", 1, End.PREEMPT, Counts.NONE)),
        ("a:going", Input("a", 1, End.GOING)),
        ("!full", Inhibitor("full")),
        ("!full*4", Inhibitor("full", 4)),
    ],
)
def test_notation_of_arcs(text: str, arc: Input | Inhibitor) -> None:
    assert read_input(text) == arc and read_input(write_arc(arc)) == arc


@pytest.mark.parametrize(
    "text", ["", "*2", "a:", "a:normal:error", "a*", "a*-1", "2*a", "!!a", "a:preempt=maybe"]
)
def test_no_arc(text: str) -> None:
    with pytest.raises(ArcError):
        read_input(text)


def test_outputs() -> None:
    assert read_output("a*2") == Output("a", 2)
    with pytest.raises(ArcError):
        read_output("a:normal")


SUBNET = (
    GOOD.replace(
        '[places.look]\nkind = "action"\ntask = "look"',
        '[places.look]\nkind = "macro"\nsubnet = "twice"',
    )
    .replace('args = { seed = { var = "seed" } }\nout = { seen = "seen" }\n', "")
    .replace('when = "seen"\n', "")
    + """
[transitions.lost]
in = ["look:error"]
out = ["runs"]

[subnets.twice]
entry = "first"
normal = "good"
error = "bad"

[subnets.twice.places.first]
kind = "action"
task = "look"

[subnets.twice.places.second]
kind = "macro"
subnet = "once"

[subnets.twice.places.good]
kind = "control"

[subnets.twice.places.bad]
kind = "control"

[subnets.twice.transitions.next]
in = ["first:normal"]
out = ["second"]
when = "first.status == 'success'"

[subnets.twice.transitions.weak]
in = ["first:normal"]
out = ["bad"]
when = "first.status != 'success'"

[subnets.twice.transitions.fail]
in = ["first:error"]
out = ["bad"]

[subnets.twice.transitions.end]
in = ["second:normal"]
out = ["good"]

[subnets.once]
entry = "run"
normal = "over"

[subnets.once.places.run]
kind = "action"
task = "look"

[subnets.once.places.over]
kind = "control"

[subnets.once.transitions.any]
in = ["run:normal"]
out = ["over"]

[subnets.once.transitions.bad]
in = ["run:error"]
out = ["over"]
"""
)


def test_macro_places_unfold_with_prefixed_names() -> None:
    task = loads(SUBNET)
    assert loads(dumps(task)) == task and task.places["look"].subnet == "twice"
    flat = task.flat
    assert set(flat.places) == {
        "runs",
        "done",
        "look.first",
        "look.second.run",
        "look.second.over",
        "look.good",
        "look.bad",
    }
    assert flat.transitions["start"].outputs == (Output("look.first"),)
    assert flat.transitions["found"].inputs == (Input("look.good"),)
    assert flat.transitions["lost"].inputs == (Input("look.bad"),)
    assert flat.transitions["look.next"].outputs == (Output("look.second.run"),)
    assert flat.transitions["look.end"].inputs == (Input("look.second.over"),)
    when = flat.transitions["look.next"].when
    assert when is not None and when.text == "look.first.status == 'success'"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('subnet = "once"', 'subnet = "twice"', "contains itself"),
        ('subnet = "once"', 'subnet = "one"', "did you mean 'once'"),
        ('entry = "first"', 'entry = "frist"', "did you mean 'first'"),
        ('normal = "good"', 'normal = "first"', "end in a place without `kind`"),
        ('["second:normal"]', '["second:error"]', "has no error exit"),
        ('["second:normal"]', '["second"]', "is a macro place"),
        ('["second:normal"]', '["second:normal", "!second"]', "inhibitor arc from the macro place"),
        (
            'kind = "macro"\nsubnet = "once"',
            'kind = "macro"\nsubnet = "once"\ntokens = 1',
            "cannot hold tokens",
        ),
    ],
)
def test_faults_of_subnets(old: str, new: str, words: str) -> None:
    assert old in SUBNET
    with pytest.raises(TaskFileError, match=words):
        loads(SUBNET.replace(old, new, 1))


@pytest.mark.parametrize(
    ("old", "new", "key", "line"),
    [
        (
            'subnet = "once"',
            'subnet = "twice"',
            "subnets.twice.places.second.subnet",
            'subnet = "twice"',
        ),
        (
            "when = \"first.status == 'success'\"",
            'when = "first.status == 1"',
            "subnets.twice.transitions.next.when",
            'when = "first.status == 1"',
        ),
    ],
)
def test_faults_within_subnets_have_their_lines(old: str, new: str, key: str, line: str) -> None:
    text = SUBNET.replace(old, new, 1)
    with pytest.raises(TaskFileError) as caught:
        loads(text)
    lines = dict(zip([f.key for f in caught.value.faults], caught.value.lines, strict=True))
    assert text.splitlines()[lines[key] - 1] == line
    assert lines[key] > text.splitlines().index("[subnets.twice]")


def test_example_of_the_documentation_is_a_sound_task() -> None:
    text = (Path(__file__).parents[2] / "docs" / "task-file.md").read_text(encoding="utf-8")
    example = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)[0]
    assert check(loads(example)).findings == ()


def test_a_file_may_begin_with_a_byte_order_mark() -> None:
    """Some editors write one; it changes nothing."""
    assert loads("\ufeff" + GOOD) == loads(GOOD)
