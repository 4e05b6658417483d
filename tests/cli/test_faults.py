"""Messages of commands about bad input: file, line if there is one, key and remedy; never an
exception's name."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from petrobot.coordinator.analysis.may_run import Budget
from petrobot.coordinator.cli import COMMANDS, main
from petrobot.coordinator.cli.new import skeleton
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.lockstep.party import Party

WORK = skeleton("task.toml", "work")
CELL = """\
schema = 1
[nodes.robot]
host = "127.0.0.1"
port = 7399
[actions.work]
run = "petrobot.services.scripted:nothing"
task = "work"
node = "robot"
[actions.recover]
run = "petrobot.services.scripted:nothing"
task = "recover"
node = "robot"
"""
NO_CELL = (
    "astray.toml:5: task.services: no such file: no.toml; name one relative to "
    "astray.toml, drop the key, or give --services"
)
Petrobot = Callable[..., tuple[int, str, str]]


@pytest.fixture
def petrobot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Petrobot:
    """A function that runs a command in a folder with work.toml, services.toml and other files, and
    returns exit code, standard output and standard error."""
    monkeypatch.chdir(tmp_path)
    files: dict[str, str | bytes] = {
        "work.toml": WORK,
        "astray.toml": WORK.replace("[task]", '[task]\nservices = "no.toml"'),
        "folder.toml": WORK.replace("[task]", '[task]\nservices = "."'),
        "binary.toml": b"schema = 1\n\xff\xfe\n",
        "services.toml": CELL,
        "rates.toml": "[rates]\n",
        "fails.toml": "schema = 1\n"
        + "".join(f'[actions.{a}]\nstatus = "error"\ncause = "x"\n' for a in ("work", "recover")),
        "mock.toml": "schema = 1\n[actions.work]\nseconds = 1\n[[actions.recovre]]\nseconds = 1\n",
        "bell.toml": WORK + "\n[events.bell]\n",
        "bell_mock.toml": 'schema = 1\n[actions.work]\nevents = [{ name = "bell" }]\n',
        "list.json": "[]",
        "result.json": "[]",
        "campaign.json": '{"schema": 1}',
    }
    for name, content in files.items():
        Path(name).write_bytes(content if isinstance(content, bytes) else content.encode())

    def run(*arguments: str) -> tuple[int, str, str]:
        capsys.readouterr()
        code = main(arguments)
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("check astray.toml", NO_CELL),
        ("check astray.toml --live", NO_CELL),
        ("run astray.toml", NO_CELL),
        ("campaign astray.toml", NO_CELL),
        ("check folder.toml", "folder.toml:5: task.services: . is not a file"),
        (
            "analyse work.toml --rates nope.toml",
            "--rates: nope.toml: work is a task; rates are for net files; leave it out",
        ),
        ("analyse work.toml --view gspn --rates rates.toml", "--rates: rates.toml: work is a task"),
        ("simulate work.toml --rates unit", "--rates: unit: work is a task"),
        ("analyse binary.toml", "petrobot analyse: binary.toml:2: file: is not UTF-8"),
        ("simulate binary.toml", "petrobot simulate: binary.toml:2: file: is not UTF-8"),
        ("convert binary.toml x.pnml", "petrobot convert: binary.toml:2: file: is not UTF-8"),
        (
            "convert work.toml x.foo",
            "x.foo: file: no writer for the ending .foo; end its name in .pnml, .net, .pnpro, "
            ".lola, .dot, .drn",
        ),
        ("new action class", "'class' is a keyword of Python"),
        ("new action Fast", "use small letters, digits and _"),
        (
            "run work.toml --mode lockstep --mock mock.toml",
            "mock.toml:4: actions.recovre: services.toml has no such action",
        ),
        (
            "run bell.toml --mode lockstep --mock bell_mock.toml",
            "bell_mock.toml:2: actions.work: 'bell' is an external event of work, which no action",
        ),
        (
            "campaign bell.toml --mock bell_mock.toml",
            "bell_mock.toml:2: actions.work: 'bell' is an external event of work, which no action",
        ),
        (
            "check work.toml --services no.toml",
            "no.toml: No such file or directory; give --services a location file",
        ),
        (
            "campaign work.toml --mock no.toml",
            "no.toml: No such file or directory; give a file of scripted",
        ),
        (
            "campaign work.toml --mock mock.toml",
            "(did you mean 'recover'?); name one of its actions, or remove it here",
        ),
        (
            "forecast --compare a b",
            "a is not a forecast: No such file or directory; give a file that `petrobot "
            "forecast --out",
        ),
        ("forecast --compare work.toml b", "work.toml is not a forecast: not JSON"),
        (
            "forecast --compare list.json b",
            "list.json is not a forecast: expected an object with schema and sha256",
        ),
        ("forecast work.toml --estimates .", "campaign.json: the key 'regimes' is missing"),
        ("analyse work.toml --estimates .", "this folder holds no estimates.db; its campaign"),
        (
            "learned show .",
            "this folder holds no estimates.db; its campaign is not finished",
        ),
        (
            "campaign work.toml --learned nope",
            "not the result of a finished campaign: No such file or directory; give the folder of",
        ),
        (
            "campaign work.toml --learned .",
            "result.json: not the result of a campaign: task, selector or policy is missing",
        ),
        (
            "campaign --resume work.toml",
            "work.toml holds no campaign: campaign.json is missing; give a folder that",
        ),
    ],
)
def test_bad_input_names_file_key_and_remedy(command: str, said: str, petrobot: Petrobot) -> None:
    """The exit code is 2, and the message names no exception. Standard output is empty, but for the
    verdict of `check` on a task whose location file is at fault."""
    code, out, err = petrobot(*command.split())
    assert code == 2
    assert not out or (command.startswith("check ") and "may not run because of" in out)
    assert said in err
    assert "Error(" not in err and "Errno" not in err


@pytest.mark.processes
def test_the_location_file_in_use_is_named(petrobot: Petrobot) -> None:
    """The location file is looked for beside the task, one folder above it, and here, and no other
    cell's file is used."""
    assert petrobot("check", "work.toml")[0] == 0
    cell = Path("services.toml").read_text(encoding="utf-8")
    folder = Path("lab/tasks")
    folder.mkdir(parents=True)
    shutil.move("work.toml", folder)
    wrong = cell.replace("[actions.work]", "[actions.wrok]")
    for number, path in enumerate((folder / "services.toml", Path("lab/services.toml"))):
        path.write_text(wrong, encoding="utf-8")
        code, out, _ = petrobot("check", "lab/tasks/work.toml")
        assert code == 2 and f"add [actions.work] to {path}, or drop it here" in out, number
        path.unlink()
    Path("linked.toml").symlink_to(folder / "work.toml")
    Path("lab/services.toml").write_text(wrong, encoding="utf-8")
    here = Path("services.toml").rename("kept.toml")
    code, out, _ = petrobot("check", "linked.toml")
    assert code == 2 and "add [actions.work] to" in out and "lab/services.toml" in out, "of a link"
    here.rename("services.toml")
    Path("lab/services.toml").unlink()
    assert petrobot("check", "lab/tasks/work.toml")[0] == 0, "the one here"
    Path("services.toml").unlink()
    code, out, _ = petrobot("check", "lab/tasks/work.toml")
    assert code == 0
    assert "there is no services.toml beside the task" in out and "was not checked" in out
    code, _, err = petrobot("run", "lab/tasks/work.toml")
    assert code == 2 and "there is no services.toml beside the task" in err


@pytest.mark.processes
def test_an_action_for_another_primitive_task_is_a_warning(petrobot: Petrobot) -> None:
    """This is a warning; the task may still run."""
    Path("services.toml").write_text(
        CELL.replace('task = "work"', 'task = "wrok"'), encoding="utf-8"
    )
    code, out, _ = petrobot("check", "work.toml")
    assert code == 0
    found = " ".join(out.split())
    assert (
        "warning work.toml:12: primitive_tasks.work.alternatives: services.toml says that "
        "the action 'work' does the primitive task 'wrok'" in found
    )
    assert "write task = 'work' in its [actions.work]" in found


@pytest.mark.processes
def test_check_does_not_promise_that_analyse_searches_longer(petrobot: Petrobot) -> None:
    """`analyse` searches longer than `check`, but not if the net is unbounded."""
    endless = WORK.replace('out = ["robot_free"]', 'out = ["robot_free", "runs*2"]', 1)
    Path("work.toml").write_text(endless, encoding="utf-8")
    code, out, _ = petrobot("check", "work.toml")
    found = " ".join(out.split())
    assert code == 2 and "NO bounded" in found
    assert "cut short (the net is unbounded)" in found and "continues longer" not in found


@pytest.mark.processes
def test_a_search_that_was_cut_short_may_be_continued(
    petrobot: Petrobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If a limit ended the search, `check` refers to `analyse`, which has a larger limit."""
    monkeypatch.setattr("petrobot.coordinator.analysis.may_run.BUDGET", Budget(4))
    out = petrobot("check", "work.toml")[1]
    assert "petrobot analyse continues longer" in " ".join(out.split())


@pytest.mark.parametrize("name", [command.name for command in COMMANDS])
def test_help_says_which_location_file_is_used(name: str, petrobot: Petrobot) -> None:
    """The location file that the task names comes first."""
    out = " ".join(petrobot(name, "--help")[1].split())
    assert "--services FILE the" not in out or "the one that the task names in its key" in out


def test_help_explains_exit_codes(petrobot: Petrobot) -> None:
    """Help also says what 1 means for commands that run no task."""
    code, out, _ = petrobot("--help")
    assert code == 0
    told = out.partition("exit codes:")[2]
    assert all(
        word in told
        for word in ("analyse refutes", "forecast or replay", "operator's command", "3  a node")
    )


def test_an_interrupt_during_the_imports_is_an_interrupt(
    petrobot: Petrobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(name: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("importlib.import_module", interrupted)
    code, _, said = petrobot("check", "work.toml")
    assert (code, said) == (130, "interrupted\n")


GOLDEN = Path(__file__).parents[1] / "run" / "golden"
JOURNAL = str(GOLDEN / "catch_ball-missed-and-recovered.journal")


@pytest.mark.processes
@pytest.mark.parametrize(
    "words",
    [
        ("--help",),
        ("log", "--help"),
        ("log", JOURNAL),
        ("log", JOURNAL, "--format", "jsonl"),
        ("log", JOURNAL, "--format", "xes"),
        ("replay", JOURNAL),
        ("check", "work.toml"),
        ("analyse", "work.toml"),
        ("show", "work.toml"),
        ("convert", "work.toml", "work.pnml", "--json", "-"),
        ("simulate", "work.pnml", "--rates", "unit", "--horizon", "9"),
        ("run", "work.toml", "--mode", "lockstep"),
        ("learned", "show", "kept.estimates"),
        ("forecast", "work.toml", "--estimates", "kept.estimates"),
        ("new", "robot", "carrier"),
    ],
    ids=" ".join,
)
def test_a_reader_that_leaves_is_no_answer(
    words: tuple[str, ...],
    petrobot: Petrobot,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """`petrobot check TASK | head -1` must not end as if the task might not run."""
    if "kept.estimates" in words:
        learnt = ("--learn", "kept.estimates", "--selector", "fixed", "--quiet")
        ran = ("run", "work.toml", "--mode", "lockstep", *learnt, "--mock", "fails.toml")
        petrobot(*ran)
    petrobot("convert", "work.toml", "work.pnml", "--view", "ordinary")
    reading, writing = os.pipe()
    os.close(reading)
    closed = os.fdopen(writing, "w", encoding="utf-8")
    with closed, monkeypatch.context() as patched:
        patched.setattr("sys.stdout", closed)
        code = main(words)
    assert code == 141 and f"petrobot {words[0]}:" not in capsys.readouterr().err


@pytest.mark.processes
def test_python_says_nothing_more_of_a_closed_pipe_at_its_exit() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "petrobot.coordinator", "check", "catch_ball"]
    ended = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (ended.returncode, ended.stderr) == (141, "")


def no_laboratory(directory: Directory, name: str) -> Party:
    """Return a laboratory whose file no longer exists, as after an uninstallation."""
    raise ValueError("gone.toml: cannot be read (No such file or directory)")


def test_a_laboratory_that_cannot_be_made_is_named(petrobot: Petrobot) -> None:
    lab = f'[nodes.lab]\nhost = "127.0.0.1"\nport = 7398\nsim = "{__name__}:no_laboratory"\n'
    Path("cell.toml").write_text(CELL + lab, encoding="utf-8")
    run = ("run", "work.toml", "--services", "cell.toml", "--mode", "lockstep", "--quiet")
    code, _, said = petrobot(*run)
    assert code == 2 and "Traceback" not in said
    assert "cell.toml: nodes.lab: gone.toml: cannot be read" in said


@pytest.mark.processes
def test_standard_files_that_the_caller_has_closed(tmp_path: Path) -> None:
    """Nothing is printed into a file that got the number of one of them."""
    command = f"{shlex.quote(sys.executable)} -m petrobot.coordinator"
    robot = f"{command} new robot carrier"
    ran = f"{command} run carrier.toml --mode lockstep --journal runs"
    script = f"{robot} <&- >&- 2>&- && cd carrier && {ran} <&- >&- 2>&- && {command} log last >&-"
    done = subprocess.run(
        ["sh", "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0 and done.stdout == done.stderr == ""
    assert (tmp_path / "carrier" / "services.toml").read_text().startswith("schema = 1")
