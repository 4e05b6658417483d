"""What `check` prints: the answer first, each finding in short lines, nothing wider than a
terminal."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
from msgspec.structs import replace

from petrobot.coordinator.analysis import may_run, report
from petrobot.coordinator.analysis.execution.graph import Shared
from petrobot.coordinator.analysis.execution.progress import Progress, progress_of
from petrobot.coordinator.analysis.net.ordinary import OrdinaryView
from petrobot.coordinator.analysis.time.measured import Measured
from petrobot.coordinator.background import analysed
from petrobot.coordinator.cli import main
from petrobot.coordinator.cli.loading import (
    find_cell,
    load_directory,
    load_task,
    objections,
    task_path,
)
from petrobot.coordinator.operator.task_check import cell_of
from petrobot.coordinator.page.task_work import findings
from petrobot.coordinator.task.conditions import parse
from petrobot.services.comm.location_file import load
from petrobot.services.comm.location_file.code import read_code
from tests.ports import free_ports
from tests.processes import alive
from tests.waiting import until

HEAD = """schema = 1
[task]
name = "parts"
final = "parts == 0 and arm == 1"
[primitive_tasks.look]
goal = "the part is found"
alternatives = ["look_once"]
deadline = 5.0
[places]
parts = { kind = "control", tokens = 2 }
arm = { kind = "resource", tokens = 1 }
look = { kind = "action", task = "look" }
[transitions]
next = { in = ["parts", "arm"], out = ["look"] }
seen = { in = ["look:normal"], out = ["arm"] }
"""


ROOT = Path(__file__).parents[2]
TASKS = [
    *(path.stem for path in sorted((ROOT / "coordinator" / "tasks").glob("*.toml"))),
    *(
        str(path)
        for path in sorted((ROOT / "examples").glob("*/*.toml"))
        if path.name != "services.toml"
    ),
]
"""All tasks that come with petrobot."""


@pytest.fixture
def searched_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search the states of a task once for the same question of `check` and of the page. A question
    that differs is searched again."""
    known: list[tuple[object, Progress]] = []

    def search(
        view: OrdinaryView,
        limit: int,
        measured: Measured | None = None,
        devices: Mapping[str, str] | None = None,
        shared: Shared | None = None,
    ) -> Progress:
        asked = (view.task, limit, measured, devices)
        for before, progress in known:
            if before == asked:
                return progress
        known.append((asked, progress_of(view, limit, measured, devices, shared)))
        return known[-1][1]

    monkeypatch.setattr(report, "progress_of", search)


@pytest.mark.processes
@pytest.mark.usefixtures("searched_once")
@pytest.mark.parametrize("name", TASKS, ids=lambda name: Path(name).stem)
def test_the_page_finds_what_check_finds(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Both lists are equal, with the findings about the code and those that the states decide. What
    the page says before the search does not contradict them."""
    main(["check", name, "--json", "-"])
    told = json.loads(capsys.readouterr().out)["findings"]
    path, task = task_path(name), load_task(name)
    services = str(find_cell(None, name, task) or "")
    given = (path.read_text(encoding="utf-8"), path.name, None, services)
    assert [f for f in told if f["key"] != "services.toml"] == next(analysed(*given))["findings"]
    assert all(finding in told for finding in findings(*given))


def printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, command: str = "check"
) -> tuple[int, list[str]]:
    """Run a command on a task in a folder without a location file."""
    (tmp_path / "parts.toml").write_text(text, encoding="utf-8")
    with contextlib.chdir(tmp_path):
        code = main([command, "parts.toml"])
    return code, capsys.readouterr().out.splitlines()


def test_a_dead_end_is_told_in_short_lines(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, lines = printed(tmp_path, capsys, HEAD + 'lost = { in = ["look:error"], out = [] }\n')
    assert code == 2 and lines[0] == "parts.toml: may not run"
    assert lines[1].startswith("  yes       bounded, ")
    first = lines.index("")
    assert lines[first + 1 : first + 7] == [
        "error   deadlock free: stuck with parts: next needs arm, which is empty",
        "        arm: taken by `next`, never returned by `lost`",
        "        `final` cannot be reached any more after: look ends in error -> lost",
        "        by: the mission begins -> next",
        "            look ends in error -> lost",
        "        so it is not sound, live, proper, stable, controllable",
    ]
    kinds = [line.split()[0] for line in lines[first + 1 :] if line[:1].strip()]
    assert kinds == sorted(kinds, key=["error", "warning", "note", "petrobot"].index)


@pytest.mark.parametrize("command", ["check", "analyse"])
def test_no_line_is_wider_than_a_terminal(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Steps and causes with long names in a task that gets stuck late, and of which the operator
    can make more dead ends."""
    text = HEAD.replace("look", "look_for_the_next_part_on_the_long_conveyor").replace("= 2", "= 9")
    text += 'lost = { in = ["look_for_the_next_part_on_the_long_conveyor:error"], out = ["arm"] }\n'
    text = text.replace(
        '"], out = ["arm"] }', ', "tray"], out = ["arm"] }'.replace(', "', '", "'), 1
    )
    text = text.replace("[transitions]", 'tray = { kind = "control", tokens = 7 }\n[transitions]')
    _, lines = printed(tmp_path, capsys, text, command)
    assert len(lines) > 15
    assert all(len(line) <= 100 or " " not in line.strip() for line in lines)


def test_what_was_not_proved_is_said_in_the_first_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(may_run, "BUDGET", may_run.Budget(markings=50, steps=100))
    text = HEAD + 'lost = { in = ["look:error"], out = ["arm", "bin"] }\n'
    for old, new in (
        ("tokens = 2", "tokens = 90"),
        ("arm == 1", "arm == 1 and bin == 0"),
        ("[primitive", 'runs_place = "parts"\n[primitive'),
        ("[transitions]", 'bin = { kind = "control" }\n[transitions]'),
    ):
        text = text.replace(old, new, 1)
    code, lines = printed(tmp_path, capsys, text)
    assert code == 0 and lines[0] == "parts.toml: may run, but not everything was proved"
    told = " ".join(" ".join(lines).split())
    assert "warning with 1 run: not deadlock free: stuck with bin: " in told
    assert "by: the mission begins -> next; look ends in error -> lost" in told


def test_the_first_line_names_a_time_that_is_too_short(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every verdict holds, and yet the task nearly always gives up."""
    text = HEAD + 'lost = { in = ["look:error"], out = ["arm"] }\n'
    text += "[primitive_tasks.look.estimates]\n"
    text += "success = { share = 1.0, mean = 5.0, cv = 0.1 }\n"
    short = text.replace('task = "look"', 'task = "look", timeout = 1.0', 1)
    assert short != text
    assert printed(tmp_path, capsys, text)[1][0] == "parts.toml: may run"
    code, lines = printed(tmp_path, capsys, short)
    why = "runs take longer than places.look.timeout on average"
    assert code == 0 and lines[0] == f"parts.toml: may run, but {why}"


def test_the_first_line_says_why_a_task_may_not_run_if_its_verdicts_hold(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """That no node offers an action is not a fault of the net."""
    cell = 'schema = 1\n[nodes.robot]\nhost = "127.0.0.1"\nport = 7001\n'
    (tmp_path / "services.toml").write_text(cell, encoding="utf-8")
    text = HEAD + 'lost = { in = ["look:error"], out = ["arm"] }\n'
    code, lines = printed(tmp_path, capsys, text)
    why = "primitive_tasks.look.alternatives"
    assert code == 2 and lines[0] == f"parts.toml: may not run because of {why}"


def test_notes_of_one_kind_are_told_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    unused = "".join(f'[events.e{n}]\nscope = "external"\n' for n in range(3))
    text = HEAD + 'lost = { in = ["look:error"], out = ["arm"] }\n' + unused
    code, lines = printed(tmp_path, capsys, text)
    assert code == 0 and lines[0] == "parts.toml: may run"
    (at,) = [i for i, line in enumerate(lines) if "no transition waits for it" in line]
    assert lines[at + 2].startswith("        and 2 more such notes: petrobot check ")


NEVER_IMPORTED = """\
import os, pathlib, threading
with (pathlib.Path(__file__).parent / "importing.txt").open("a") as file:
    file.write(f"{os.getpid()}\\n")
threading.Event().wait()
"""


def cell_of_a_module_that_waits(folder: Path) -> Path:
    """Write a location file with two actions of a module whose import never ends, and one of a
    module that is well."""
    (folder / "waits.py").write_text(NEVER_IMPORTED, encoding="utf-8")
    well = "async def well(ctx):\n    pass\n"
    (folder / "well.py").write_text(well, encoding="utf-8")
    services = folder / "services.toml"
    services.write_text(
        f'schema = 1\n[nodes.pc]\nhost = "127.0.0.1"\nport = {free_ports(1)[0]}\n[actions]\n'
        'look_once = { run = "waits:look", node = "pc" }\n'
        'look_twice = { run = "waits:look_twice", node = "pc" }\n'
        'well = { run = "well:well", node = "pc" }\n',
        encoding="utf-8",
    )
    return services


@pytest.mark.processes
def test_a_module_whose_import_never_ends_is_imported_once(tmp_path: Path) -> None:
    """Each of its actions and drivers waited for the same limit, a minute each."""
    code = read_code(load(cell_of_a_module_that_waits(tmp_path)), seconds=5.0)
    assert len((tmp_path / "importing.txt").read_text().split()) == 1
    for path in ("waits:look", "waits:look_twice"):
        assert code[path]["import"].startswith("importing it took longer than 5 s"), code
    assert "import" not in code["well:well"]


@pytest.mark.processes
def test_two_cells_of_one_process_may_have_modules_of_the_same_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a page that serves the tasks of two robots: each is judged by its own code."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    for name in ("left", "right", "left"):
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        (folder / "robot.py").write_text(f"async def {name}(ctx): ...\n")
        text = 'schema = 1\nnodes.pc = { host = "127.0.0.1", port = 7561 }\n'
        (folder / "services.toml").write_text(
            f'{text}actions.go = {{ run = "robot:{name}", node = "pc" }}\n'
        )
        code = read_code(load(folder / "services.toml"))
        assert "import" not in code[f"robot:{name}"], code


@pytest.mark.processes
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
async def test_an_import_that_never_ends_ends_with_its_check(
    tmp_path: Path, how: signal.Signals
) -> None:
    """Also if `check` is killed: a process that nobody knows of was left running."""
    text = HEAD + 'lost = { in = ["look:error"], out = ["arm"] }\n'
    (tmp_path / "parts.toml").write_text(text, encoding="utf-8")
    cell_of_a_module_that_waits(tmp_path)
    check = subprocess.Popen(
        [sys.executable, "-m", "petrobot.coordinator", "check", "parts.toml"],
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    importing = tmp_path / "importing.txt"
    found = []
    try:
        await until(lambda: importing.exists() and importing.read_text(), "the import")
        found = [int(pid) for pid in importing.read_text().split()]
        check.send_signal(how)
        await until(lambda: check.poll() is not None, "the end of check")
        await until(lambda: not any(map(alive, found)), "the end of the import")
    finally:
        check.kill()
        check.wait()
        for process in filter(alive, found):
            os.kill(process, signal.SIGKILL)


@pytest.mark.processes
def test_run_does_not_repeat_the_search_of_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What it found is kept until the task, its devices or the search change."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    assert main(["new", "robot", "kept_bot"]) == 0
    monkeypatch.chdir(tmp_path / "kept_bot")
    task, cell = load_task("kept_bot.toml"), cell_of(load_directory(None))
    assert objections(replace(task, final=parse("parts == 9")), cell)
    assert main(["check", "kept_bot.toml"]) == 0
    monkeypatch.setattr(may_run, "_search", lambda *_: pytest.fail("it searched again"))
    assert objections(task, cell) == []
    assert objections(replace(task, final=parse("parts == 9")), cell)
    with pytest.raises(pytest.fail.Exception):
        objections(replace(task, final=parse("parts == 8")), cell)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"look:normal"', '"look:norml"', "'norml' is none of"),
        ("[places]", "color = 1\n[places]", "color: unknown key"),
        ('in = ["look:error"]', 'in = ["arm"]', "places.look: no outgoing arc `error`"),
    ],
)
def test_the_states_of_a_file_with_an_error_are_not_searched(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    old: str,
    new: str,
    said: str,
) -> None:
    """That takes seconds. The errors come first."""
    monkeypatch.setattr(may_run, "_search", lambda *_: pytest.fail("it searched"))
    text = HEAD + 'lost = { in = ["look:error"], out = ["arm"] }\n'
    assert old in text
    (tmp_path / "parts.toml").write_text(text.replace(old, new, 1), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert main(["check", "parts.toml"]) == 2
    first = "".join(capsys.readouterr()).splitlines()[:3]
    assert said in "".join(first) and "unknown  " not in "".join(first), first


@pytest.mark.processes
def test_an_error_in_the_code_does_not_bring_warnings_that_only_a_search_decides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The arcs alone suggest conflicts that cannot occur; they sent readers to the wrong file."""
    monkeypatch.chdir(tmp_path)
    assert main(["new", "example", "porter"]) == 0
    monkeypatch.chdir(tmp_path / "porter")
    code = Path("porter.py").read_text(encoding="utf-8")
    Path("porter.py").write_text(code.replace("await ctx.sleep(0.2)", "ctx.sleep(0.2)"))
    capsys.readouterr()
    assert main(["check", "deliver.toml"]) == 2
    told = "".join(capsys.readouterr())
    assert "does nothing without `await`" in told and "warning" not in told, told


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("schema = 1", "", ("schema", 1, "missing")),
        ('"control"', "control", ("", 10, "not valid TOML: control is a text without quotes")),
        ("[places]", "[places", ("", 9, "not valid TOML")),
        ('"look:normal"', '"zzz:normal"', ("transitions.seen.in", 15, "unknown place")),
    ],
)
def test_faults_of_a_file_are_findings_of_the_json(
    tmp_path: Path, old: str, new: str, found: tuple[str, int, str]
) -> None:
    """It was not written beside them."""
    text = HEAD + 'lost = { in = ["look:error"], out = ["arm"] }\n'
    (tmp_path / "parts.toml").write_text(text.replace(old, new, 1), encoding="utf-8")
    (tmp_path / "services.toml").write_text("[nodes]\n", encoding="utf-8")
    with contextlib.chdir(tmp_path):
        assert main(["check", "parts.toml", "--json", "told.json"]) == 2
    told = json.loads((tmp_path / "told.json").read_text(encoding="utf-8"))
    assert told["ok"] is False and "analysis" not in told
    first = told["findings"][0]
    assert (first["key"], first["line"]) == found[:2] and first["text"].startswith(found[2])
    assert any(one["key"] == "services.toml:1: schema" for one in told["findings"])
