"""Reading services.toml: its contents, and one message with line, key and remedy for each fault."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from petrobot.services.comm.location_file import (
    Directory,
    DirectoryError,
    load,
    parse,
    verify_imports,
)

GOOD = """\
schema = 1
[parameters]
cell = "cell.toml"
[nodes.vision]
host = "127.0.0.1"
port = 7301
[nodes.motion]
host = "127.0.0.1"
port = 7302
[nodes.world]
host = "127.0.0.1"
port = 7300
sim = "petrobot.sim.catching.laboratory:make_laboratory"
[devices.eye]
node = "vision"
driver = "json:JSONDecoder"
source = "sim"
[devices.hand]
node = "motion"
driver = "json:JSONEncoder"
[actions.look]
run = "json:loads"
task = "find"
device = "eye"
deadline = 5
[actions.look_twice]
run = "json:loads"
task = "find"
device = "eye"
args = { times = 2 }
start = "at_once"
[actions.add]
run = "json:dumps"
task = "sum"
node = "motion"
[services.memory]
node = "vision"
[services.secret]
node = "motion"
run = "json:dumps"
scope = "local"
[services.throw]
node = "world"
[streams.where]
to = "hand"
period = 0.02
[timers.beat]
node = "vision"
period = 0.04
[links]
call = 0.008
image = 0.2
"look/world" = 0.4001
"""


def good() -> Directory:
    return parse(GOOD, Path("cell/services.toml"))


def test_a_valid_file() -> None:
    d = good()
    assert (
        d.where("look") == "vision" and d.where("add") == "motion" and d.where("where") == "motion"
    )
    assert (
        d.where("memory.get") == "vision"
        and d.where("beat") == "vision"
        and d.where("eye") == "vision"
    )
    assert {a.name: a.node for a in d.actions.values() if a.task == "find"} == {
        "look": "vision",
        "look_twice": "vision",
    }
    assert d.devices["eye"].config == {"source": "sim"}
    assert d.actions["look"].orphan_time == 1.0 and d.actions["add"].orphan_time is None
    assert d.actions["look"].deadline == 5.0 and d.actions["look_twice"].at_once
    assert d.services["secret"].local and not d.services["memory"].local
    assert d.address("motion") == ("127.0.0.1", 7302) and d.nodes["world"].sim
    assert d.file(d.parameters["cell"]) == Path("cell/cell.toml")


def test_hash_is_of_the_data_not_of_the_text() -> None:
    assert parse("# a comment\n" + GOOD, Path("elsewhere.toml")).hash == good().hash
    assert parse(GOOD.replace("7301", "7303"), Path("services.toml")).hash != good().hash


def test_link_delays_are_whole_ticks() -> None:
    assert good().delays() == {"call": 2, "image": 50, "look/world": 101}


FAULTS = [
    ("schema = 1", "schema = 2", ":1: schema: is 2; write schema = 1"),
    ("schema = 1\n", "", "schema: is missing; write schema = 1"),
    ("[timers.beat]", "[timer.beat]", ":47: timer: unknown table; did you mean 'timers'?"),
    (
        "port = 7301",
        "port = 7302",
        "127.0.0.1:7302 is already node 'vision''s; give each its own port",
    ),
    (
        "port = 7301",
        "port = 70000",
        ":6: nodes.vision.port: is 70000; write a port from 1 to 65535",
    ),
    ("port = 7301", "port = true", ":6: nodes.vision.port: is True; write a port from 1 to 65535"),
    ("port = 7301\n", "", ":4: nodes.vision.port: is missing; write a port from 1 to 65535"),
    ("port = 7301", "prot = 7301", "nodes.vision.prot: unknown key; did you mean 'port'?"),
    (
        'node = "vision"\ndriver',
        'node = "vison"\ndriver',
        "no node is named 'vison'; did you mean 'vision'?",
    ),
    (
        'driver = "json:JSONDecoder"\n',
        "",
        'devices.eye.driver: is missing; write an import path "module:Class"',
    ),
    (
        '"json:JSONDecoder"',
        '"json.JSONDecoder"',
        "devices.eye.driver: is 'json.JSONDecoder'; write an import path",
    ),
    (
        'device = "eye"\ndeadline',
        'device = "ear"\ndeadline',
        "actions.look.device: no device is named 'ear'",
    ),
    ('device = "eye"\ndeadline', "deadline", 'actions.look: is on no node; write device = "..."'),
    (
        'device = "eye"\ndeadline',
        'device = "eye"\nnode = "motion"\ndeadline',
        "actions.look.node: is on two nodes",
    ),
    (
        'node = "motion"\n[services.m',
        'node = ["motion", "vision"]\n[services.m',
        "write the name of one node",
    ),
    (
        "[actions.look_twice]",
        "[actions.look]",
        "actions.look: already written in line 21; drop one of the two, or rename it",
    ),
    (
        "[actions.add]",
        "[actions.beat]",
        "timers.beat: the name is taken by actions.beat; rename one of them",
    ),
    ('task = "sum"\n', "task = 3\n", "actions.add.task: is 3; write the name of the primitive"),
    (
        "deadline = 5",
        "deadline = 0",
        ":25: actions.look.deadline: is 0; write a number of seconds above 0 and below 1e9",
    ),
    (
        "deadline = 5",
        "deadline = nan",
        "actions.look.deadline: is nan; write a number of seconds above 0 and below 1e9",
    ),
    ("deadline = 5", "deadlin = 5", "actions.look.deadlin: unknown key; did you mean 'deadline'?"),
    ("deadline = 5", 'on_resume = "retry"', 'write one of "rejoin", "error", "ask"'),
    ('start = "at_once"', 'start = "now"', 'write one of "when_stopped", "at_once"'),
    (
        'run = "json:dumps"\nscope',
        "scope",
        'services.secret.run: is missing; write an import path (only "memory"',
    ),
    (
        'scope = "local"',
        'scope = "host"',
        'services.secret.scope: is \'host\'; write one of "network", "local"',
    ),
    ('to = "hand"', 'to = "foot"', "streams.where.to: no device is named 'foot'"),
    (
        "period = 0.02",
        "period = -1",
        "streams.where.period: is -1; write a number of seconds above 0 and below 1e9",
    ),
    (
        "period = 0.04\n",
        "",
        "timers.beat.period: is missing; write a number of seconds above 0 and below 1e9",
    ),
    (
        "call = 0.008",
        "call = 0.001",
        ":51: links.call: is 0.001; write a delay in seconds, 0.004 (one tick) or more",
    ),
    (
        "call = 0.008",
        "cal = 0.008",
        "links.cal: unknown link; write a channel or \"source/target\"; did you mean 'call'?",
    ),
    (
        'cell = "cell.toml"',
        "cell = 3",
        "parameters.cell: is 3; write the path of a file, relative to this one",
    ),
    ("[devices.hand]", '[devices."a hand"]', "a name has letters, digits, _ and - only"),
    ("port = 7301", "port = ", ":6: not valid TOML"),
    (GOOD, "schema = 1\n", "nodes: no node here; write at least one [nodes.NAME]"),
    ("[links]\ncall = 0.008\n", "[links_]\n", "links_: unknown table; did you mean 'links'?"),
]


@pytest.mark.parametrize(("old", "new", "says"), FAULTS)
def test_faults_are_named_with_their_remedy(old: str, new: str, says: str) -> None:
    assert old in GOOD
    with pytest.raises(DirectoryError) as caught:
        parse(GOOD.replace(old, new, 1), Path("cell/services.toml"))
    assert says in str(caught.value), str(caught.value)
    assert all(fault.startswith("cell/services.toml") for fault in caught.value.faults)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("port = 7301", "port = 0", ":4: nodes.pc.port: is 0; write a port"),
        ('node = "pc"', 'node = "pcc"', ":6: devices.arm.node: no node is named 'pcc'"),
        (', device = "arm"', "", ":8: actions.look: is on no node"),
        ("deadline = 5", "dedline = 5", ":8: actions.look.dedline: unknown key"),
        ("0.008", "-1", ":10: links.look/world: is -1"),
    ],
)
def test_faults_in_inline_tables_have_their_lines(old: str, new: str, message: str) -> None:
    text = """schema = 1

[nodes]
pc = { host = "127.0.0.1", port = 7301 }
[devices]
arm = { node = "pc", driver = "json:JSONDecoder" }
[actions]
look = { run = "json:loads", device = "arm", deadline = 5 }
[links]
"look/world" = 0.008
"""
    with pytest.raises(DirectoryError) as caught:
        parse(text.replace(old, new, 1), Path("services.toml"))
    assert message in str(caught.value)


def test_all_faults_are_reported_at_once() -> None:
    text = (
        GOOD.replace("port = 7301", "port = 0")
        .replace("deadline = 5", "deadline = -5")
        .replace("to =", "too =")
    )
    with pytest.raises(DirectoryError) as caught:
        parse(text, Path("services.toml"))
    assert len(caught.value.faults) == 4  # two numbers, an unknown key, a missing one


def test_an_unknown_name_gets_the_nearest_as_a_suggestion() -> None:
    with pytest.raises(DirectoryError, match="nothing is named 'lok'; did you mean 'look'"):
        good().where("lok")


def test_an_unreadable_file_raises_the_systems_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "services.toml")


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("json:JSONDecode", "'json' has no callable 'JSONDecode'; did you mean 'JSONDecoder'?"),
        (
            "jsonn:loads",
            "cannot import 'jsonn' (No module named 'jsonn'); put it beside the location file",
        ),
        (
            "broken_driver:Driver",
            "importing 'broken_driver' raises ZeroDivisionError: division by zero "
            "(broken_driver.py:1); correct the module",
        ),
        (
            "ends_itself:main",
            "importing 'ends_itself' raises SystemExit: 0 (ends_itself.py:3); correct the module",
        ),
        (
            "speechless:main",
            "importing 'speechless' raises Mute: <exception str() failed> (speechless.py:3); "
            "correct the module",
        ),
        (
            "unfinished:main",
            "importing 'unfinished' raises SyntaxError: '(' was never closed (unfinished.py:2); "
            "correct the module",
        ),
    ],
)
def test_imports_are_verified_on_the_host_that_runs_them(
    path: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_driver.py").write_text("1 / 0\n")
    (tmp_path / "ends_itself.py").write_text("import sys\ndef main(): ...\nsys.exit(0)\n")
    mute = "class Mute(Exception):\n    def __str__(self): raise self\nraise Mute\n"
    (tmp_path / "speechless.py").write_text(mute)
    (tmp_path / "unfinished.py").write_text("import os\nprint(\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    directory = parse(GOOD.replace("json:JSONDecoder", path), Path("services.toml"))
    (fault,) = verify_imports(directory, "vision")
    assert fault.startswith(f"services.toml: devices.eye.driver: {says}")
    assert verify_imports(directory, "motion") == ()


def test_an_action_in_a_laboratorys_own_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "our_laboratory"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "grasp.py").write_text("def grasp(ctx, *, force=1.0): ...\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    directory = parse(
        GOOD.replace("json:dumps", "our_laboratory.grasp:grasp"), Path("services.toml")
    )
    assert verify_imports(directory, "motion") == ()
    assert "our_laboratory.grasp" in sys.modules
