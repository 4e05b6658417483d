"""Thirty mistakes of newcomers in the shipped services.toml: each gives one line with file, key and
remedy, and exit code 2."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from petrobot.services.comm.location_file import DirectoryError, code as location_code, load, parse
from petrobot.services.comm.location_file.host_checks import misplaced, signatures
from petrobot.services.comm.protocol.security import is_loopback
from tests.cli.test_mistakes import said as told

SHIPPED = Path(__file__).parents[2] / "services.toml"
VISION = 'host = "127.0.0.1"\nport = 7301'
NO_KEY = "can be reached by other hosts, and there is no key; make one with `petrobot keys`"
MISTAKES: list[tuple[str, str, str]] = [
    ("port = 7301", "port = 7301.0", ":23: nodes.vision.port: is 7301.0; write a port"),
    ("port = 7301", 'port = "7301"', ":23: nodes.vision.port: is '7301'; write a port"),
    (
        "port = 7302",
        "port = 7301",
        ":28: nodes.motion.port: 127.0.0.1:7301 is already node 'vision''s",
    ),
    (
        "port = 7302",
        "port = 7299",
        "coordinator.port: 127.0.0.1:7299 is already node 'motion''s; give each its own port",
    ),
    (
        "schema = 1",
        "schema = 1\n[coordinator]\nport = 7301",
        ":11: coordinator.port: 127.0.0.1:7301 is already node 'vision''s",
    ),
    (
        VISION,
        'host = "127.0.0.1:7301"\nport = 7301',
        ":22: nodes.vision.host: is '127.0.0.1:7301'; write a host name or address",
    ),
    (
        VISION,
        'host = "300.1.2.3"\nport = 7301',
        ":22: nodes.vision.host: is '300.1.2.3'; write a host name or address",
    ),
    (
        VISION,
        'host = "the vision pc"\nport = 7301',
        ":22: nodes.vision.host: is 'the vision pc'; write a host name",
    ),
    (VISION, 'host = "192.168.1.5"\nport = 7301', f":22: nodes.vision.host: 192.168.1.5 {NO_KEY}"),
    (VISION, 'host = "vision-pc"\nport = 7301', f":22: nodes.vision.host: vision-pc {NO_KEY}"),
    (
        "schema = 1",
        'schema = 1\n[keys]\nfile = "lost.key"',
        ":11: keys.file: {folder}/lost.key is not there; copy it from a host that has it",
    ),
    (
        "schema = 1",
        'schema = 1\n[keys]\nshared = "cell.key"',
        ':11: keys.shared: unknown; write file = "cell.key"',
    ),
    (
        "[actions.locate_mog2]",
        "[actions.locate_background]",
        ":85: actions.locate_background: already written in line",
    ),
    (
        'device = "camera"',
        'device = "camera"\nnode = "motion"',
        ":82: actions.locate_background.node: is on two nodes",
    ),
    ('device = "camera"', "", ":78: actions.locate_background: is on no node; write device"),
    (
        'device = "camera"',
        'device = "camra"',
        ":81: actions.locate_background.device: no device is named 'camra'; did you mean 'camera'?",
    ),
    (
        "vision.camera:Camera",
        "vision.camera:Kamera",
        ":36: devices.camera.driver: 'petrobot.services.vision.camera' has no 'Kamera'; did "
        "you mean 'Camera'?",
    ),
    (
        "vision.camera:Camera",
        "vison.camera:Camera",
        ":36: devices.camera.driver: cannot find 'petrobot.services.vison.camera'",
    ),
    (
        "petrobot.services.vision.camera:Camera",
        "our_lab_camera:Camera",
        ":36: devices.camera.driver: no module 'our_lab_camera' on this host; install",
    ),
    (
        "motion.arm:Arm",
        "motion.arm.Arm",
        ":44: devices.arm.driver: is 'petrobot.services.motion.arm.Arm'; write an import "
        'path "module:Class"',
    ),
    (
        "actions:locate_background",
        "actions:locate_backgroud",
        ":79: actions.locate_background.run: 'petrobot.services.vision.actions' has no",
    ),
    (
        "laboratory:make_laboratory",
        "laboratory:make_lab",
        ":19: nodes.laboratory.sim: 'petrobot.sim.catching.laboratory' has no 'make_lab'",
    ),
    (
        "deadline = 10.0",
        'deadline = "10 s"',
        ":82: actions.locate_background.deadline: is '10 s'; write a number of seconds above 0",
    ),
    (
        "deadline = 12.0",
        "args = { margn = 5 }",
        ":152: actions.follow_and_wait.args: follow_and_wait has no argument 'margn'; did "
        "you mean 'margin'?",
    ),
    (
        "deadline = 10.0",
        "args = 5",
        ":82: actions.locate_background.args: is 5; write a table of arguments",
    ),
    (
        'to = "arm"',
        'to = "army"',
        ":55: streams.catch_point.to: no device is named 'army'; did you mean 'arm'?",
    ),
    (
        "period = 0.02 ",
        "period = 0 ",
        ":56: streams.catch_point.period: is 0; write a number of seconds above 0 and below 1e9",
    ),
    (
        "period = 0.04 ",
        "perid = 0.04 ",
        ":64: timers.image_tick.perid: unknown key; did you mean 'period'?",
    ),
    (
        "[services.memory]",
        '[services.memory]\nscope = "host"',
        '.scope: is \'host\'; write one of "network", "local"',
    ),
    (
        'cell = "services/cell.toml"',
        'cell = "our_cell.toml"',
        ":188: parameters.cell: {folder}/our_cell.toml is not there; write the path",
    ),
    ("[nodes.vision]", "[node.vision]", ":21: node: unknown table; did you mean 'nodes'?"),
    ("[nodes.vision]", "[nodes.vision", ":21: not valid TOML"),
]


EMPTY = 'schema = 1\n[task]\nname = "empty"\nfinal = "true"\n'


@pytest.mark.parametrize(
    ("right", "wrong", "says"), MISTAKES, ids=[f"{wrong[:40]}" for _, wrong, _ in MISTAKES]
)
def test_each_mistake_gives_one_line(
    right: str, wrong: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`petrobot check` refuses the file, names file, line, key and remedy, and shows no
    traceback. What the code says is another matter, and takes seconds to import."""
    monkeypatch.setattr(location_code, "read_code", lambda directory: {})
    text = SHIPPED.read_text(encoding="utf-8")
    assert right in text
    path = tmp_path / "services.toml"
    path.write_text(text.replace(right, wrong, 1), encoding="utf-8")
    (tmp_path / "empty.toml").write_text(EMPTY, encoding="utf-8")
    code, said = told("check", str(tmp_path / "empty.toml"), "--services", str(path))
    assert code == 2
    assert says.format(folder=tmp_path) in said
    assert f"{path}:" in said and "Traceback" not in said


def test_everything_named_in_the_shipped_files_exists(tmp_path: Path) -> None:
    """It holds for both cells' location files; a copy in another folder still finds the shipped
    numbers."""
    track = SHIPPED.parent / "services" / "mobile" / "track.services.toml"
    for path in (SHIPPED, track):
        assert misplaced(load(path)) == misplaced(load(path), everywhere=True) == ()
    copy = tmp_path / "services.toml"
    copy.write_bytes(SHIPPED.read_bytes())
    assert misplaced(load(copy)) == ()
    own = tmp_path / "services" / "cell.toml"
    own.parent.mkdir()
    own.touch()
    assert load(copy).file("services/cell.toml") == own


def test_code_of_other_hosts_is_not_checked() -> None:
    """Code of other hosts is checked only for a lock-step cell, which runs completely here;
    scripted actions need no code."""
    text = SHIPPED.read_text(encoding="utf-8").replace(
        "actions:locate_background", "actions:elsewhere", 1
    )
    away = parse(text.replace(VISION, 'host = "10.0.0.7"\nport = 7301'), SHIPPED)
    assert all("no key" in line for line in misplaced(away))
    assert any("elsewhere" in line for line in misplaced(away, everywhere=True))
    here = parse(text, SHIPPED)
    assert any("elsewhere" in line for line in misplaced(here))
    assert misplaced(here, actions=False) == ()


def test_names_that_only_running_the_module_defines_are_accepted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A module that defines names under a condition, accepts any keyword or is not Python source is
    checked only when the node starts."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "conditional_lab.py").write_text("import sys\nif sys:\n    look = len\n")
    (tmp_path / "open_lab.py").write_text("async def look(ctx, **anything): ...\n")
    (tmp_path / "broken_lab.py").write_text("def look(ctx:\n")
    text = SHIPPED.read_text(encoding="utf-8")
    for module in ("conditional_lab", "open_lab", "broken_lab", "math"):
        run = text.replace(
            "petrobot.services.vision.actions:locate_background", f"{module}:look", 1
        )
        assert (
            misplaced(parse(run.replace("deadline = 10.0", "args = { nosuch = 5 }", 1), SHIPPED))
            == ()
        )


def test_a_module_that_another_of_its_name_hides_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.path", [*sys.path, str(tmp_path)])
    (tmp_path / "twin_lab").mkdir()
    (tmp_path / "twin_lab" / "__init__.py").touch()
    own = tmp_path / "twin_lab.py"
    own.write_text("def look(ctx): ...\n")
    text = SHIPPED.read_text(encoding="utf-8")
    run = text.replace("petrobot.services.vision.actions:locate_background", "twin_lab:look", 1)
    (line,) = misplaced(parse(run, SHIPPED))
    assert "'twin_lab' has no 'look'" in line
    assert line.endswith(f"__init__.py hides {own}: give yours another name")


def test_a_file_in_another_code_is_refused_with_its_line(tmp_path: Path) -> None:
    """A byte-order mark is accepted; Latin-1 is refused."""
    path = tmp_path / "services.toml"
    path.write_bytes(b"\xef\xbb\xbf" + SHIPPED.read_bytes())
    assert load(path).hash == load(SHIPPED).hash
    path.write_bytes(b"schema = 1\n# K\xf6ln\n")
    with pytest.raises(DirectoryError, match=r"services.toml:2: file: is not UTF-8; save it as"):
        load(path)


@pytest.mark.parametrize(
    ("host", "here"),
    [
        ("127.0.0.1", True),
        ("127.0.0.2", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("vision-pc", False),
    ],
)
def test_loopback(host: str, here: bool) -> None:
    """Addresses that only this host reaches."""
    assert is_loopback(host) is here


@pytest.mark.parametrize(
    ("code", "required", "known"),
    [
        ("def go(ctx, *, to, fast=False): ...", ["to"], ["to", "fast"]),
        ("async def go(ctx, /, to, *, fast): ...", ["to", "fast"], ["to", "fast"]),
        ("def go(ctx, to=1.0): ...", [], ["to"]),
        ("def go(ctx, a): ...\ndef go(ctx): ...", [], []),
        ("def go(ctx, **more): ...", None, None),
        ("@wrapped\ndef go(ctx): ...", None, None),
        ("def go(ctx, to): ...\ngo = partial(go, to=1)", None, None),
        ("go = make()", None, None),
    ],
)
def test_the_arguments_of_an_action_are_read_from_its_source(
    code: str,
    required: list[str] | None,
    known: list[str] | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing is said of what the source does not show, such as a decorated function."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "robot_of_test.py").write_text(code)
    text = """schema = 1
[nodes]
pc = { host = "127.0.0.1", port = 7301 }
[actions]
go = { run = "robot_of_test:go", node = "pc" }
"""
    found = signatures(parse(text, tmp_path / "services.toml"), everywhere=False).get("go")
    told = None if found is None else (found["required"], list(found["parameters"]))
    assert told == (None if required is None else (required, known))
