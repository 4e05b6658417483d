"""How commands find their files: the task, services.toml, and where results go; the options for
them."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Timer
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError, file_of
from petrobot.coordinator.operator.task_check import cell_of
from petrobot.services.host.command_line import LARGEST_SEED, whole
from petrobot.services.host.json_text import json_text
from petrobot.services.host.whole_file import make_folder, write_whole

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterator, Mapping

    from petrobot.coordinator.analysis.may_run import Cell, MayRun
    from petrobot.coordinator.analysis.time.measured import Measured
    from petrobot.coordinator.task import Task
    from petrobot.services.comm.location_file import Directory

SHIPPED = Path(__file__).parents[1] / "tasks"
"""Tasks that come with petrobot; a command accepts their names without a path."""
SHIPPED_CELL = (Path(__file__).parents[2] / "services.toml").resolve()
"""The location file that comes with petrobot: that of the catching cell."""
UNKNOWN = "unknown"
"""Plant of runs in files that were written before plants were stored."""
ESTIMATES = Path("estimates")
"""Folder of the estimates files of runs that the operator's page starts."""
OWN = Path("tasks")
"""Folder of the user's own tasks; the operator's page saves there."""
SLOW = 2.0
"""Seconds after which a command says what it is doing."""


def add_task_argument(parser: argparse.ArgumentParser, *, optional: bool = False) -> None:
    """Add `TASK`."""
    parser.add_argument(
        "task",
        nargs="?" if optional else None,
        help="a task file, or the name of a task that comes with petrobot",
    )


def add_services_argument(parser: argparse.ArgumentParser) -> None:
    """Add `--services FILE`, the same for all commands."""
    parser.add_argument(
        "--services",
        metavar="FILE",
        type=Path,
        help="the location file (default: the one that the task names in its key `services`, else "
        "services.toml in this folder, else the one that comes with petrobot)",
    )


def add_estimates_argument(parser: argparse.ArgumentParser) -> None:
    """`--estimates FILE`, the same for all commands that compute with a task's numbers."""
    parser.add_argument(
        "--estimates",
        metavar="FILE",
        type=Path,
        help="an estimates file (`run --learn FILE` keeps it) or a campaign's folder: its "
        "measurements replace the estimates declared in the task",
    )


def add_seed_argument(parser: argparse.ArgumentParser) -> None:
    """Add `--seed S` of commands whose result is the same each time."""
    parser.add_argument(
        "--seed",
        type=whole(0, LARGEST_SEED),
        default=1,
        metavar="S",
        help="seed of all random numbers (default: %(default)s)",
    )


def add_mock_argument(parser: argparse.ArgumentParser) -> None:
    """Add `--mock FILE`."""
    parser.add_argument(
        "--mock", metavar="FILE", type=Path, help="replace actions by scripted ones"
    )


def add_json_argument(parser: argparse.ArgumentParser, what: str) -> None:
    """Add `--json FILE`, which `write_json` writes."""
    parser.add_argument(
        "--json", metavar="FILE", help=f"write {what} as JSON (- for standard output)"
    )


def measurements(file: Path | None) -> Callable[[Task, Cell | None], Measured] | None:
    """Return how a task in a cell gets the measurements of an estimates file, or of a campaign's
    folder; None without a file. Raises CommandError."""
    if file is None:
        return None
    from petrobot.coordinator.analysis.may_run import devices_of
    from petrobot.coordinator.learning.estimates_file import EstimatesFile
    from petrobot.coordinator.learning.propagation import measured_from

    file = estimates_path(file)
    kept = EstimatesFile(file).read()
    others = [p or UNKNOWN for p, found in kept.plants.items() if found.tallies and p != kept.plant]
    if others:
        print(
            f"{file}: the measurements are those of plant {kept.plant or UNKNOWN}, not pooled "
            f"with: {', '.join(sorted(others))}",
            file=sys.stderr,
        )

    def of(task: Task, cell: Cell | None) -> Measured:
        devices = devices_of(cell)
        found = measured_from(task, kept.estimates, kinds=kept.kinds, devices=devices)
        if not found.runs:
            known = ", ".join(sorted({k.primitive_task for k in kept.estimates.tallies})) or "none"
            text = f"{file}: nothing was measured of {task.name}; it has: {known}"
            raise CommandError(2, text)
        return found

    return of


def estimates_path(given: Path) -> Path:
    """Return an estimates file, given by its path or by the campaign's folder that holds it. Raises
    CommandError."""
    from petrobot.coordinator.studies.campaign.observed import ESTIMATES
    from petrobot.coordinator.studies.campaign.plan import MANIFEST

    if given.is_dir():
        if not (given / ESTIMATES).is_file():
            remedy = "give an estimates file, or a folder that `petrobot campaign --out` made"
            if (given / MANIFEST).is_file():
                remedy = "its campaign is not finished: the same `petrobot campaign` continues it"
            raise CommandError(2, f"{given}: this folder holds no {ESTIMATES}; {remedy}")
        return given / ESTIMATES
    if not given.exists():
        raise CommandError(2, f"{given}: no such file; `petrobot run ... --learn {given}` makes it")
    return given


def task_path(name: str) -> Path:
    """Return the file of a task, given by its path or by its name. A name is looked up in the
    folder `tasks` here, then among the shipped tasks."""
    path = Path(name)
    if path.suffix == ".toml" or (path.is_file() and path.suffix != ".py"):
        from petrobot.coordinator.run.folder import still_there

        return still_there(path)
    own = OWN / f"{name}.toml"
    if own.exists():
        return own
    shipped = SHIPPED / f"{name}.toml"
    if shipped.exists():
        return shipped
    from petrobot.coordinator.analysis.formats import READ

    if path.suffix.lower() in READ and not path.exists():
        raise CommandError(2, f"{name}: no such file")
    known = ", ".join(sorted(p.stem for p in SHIPPED.glob("*.toml")))
    text = f"give a .toml file, or a task that comes with petrobot: {known}"
    if Path(f"{name}.toml").is_file():
        text = f"did you mean {name}.toml?"
    elif path.is_dir():
        text = "this is a folder; name the .toml file of the task"
    elif path.is_file():
        text = "this is a module; name the .toml file of the task"
    raise CommandError(2, f"no task {name!r}: {text}")


def own_tasks(directory: Directory) -> Path:
    """Return the folder of the user's own tasks: `tasks` here, or if there is none, that of the
    location file if it has a task."""
    from petrobot.coordinator.page.task_store import TaskStore

    beside = directory.source.parent
    return beside if not OWN.is_dir() and TaskStore(beside).names() else OWN


def load_task(name: str) -> Task:
    """Read a task file."""
    from petrobot.coordinator.task.file import load

    path = task_path(name)
    try:
        return load(path)
    except OSError as fault:
        raise CommandError(2, f"{path}: {fault.strerror or fault}") from fault


def services_path(given: Path | None) -> Path:
    """Return the location file: the given one, else services.toml here, else the shipped one."""
    if given is not None:
        return given
    here = Path("services.toml")
    return here if here.exists() else SHIPPED_CELL


def cell_path(given: Path | None, name: str, task: Task) -> Path:
    """Return the location file of `find_cell`. Raises CommandError if there is none."""
    path = find_cell(given, name, task)
    if path is None:
        remedy = "write one (docs/location-file.md), or give --services FILE"
        raise CommandError(2, f"{name}: {MISSING_CELL}; {remedy}")
    return path


KEPT_ANSWERS = 200
"""The most answers of searches that the cache of the user keeps."""
MISSING_CELL = "there is no services.toml beside the task, one folder above it, or here"


def find_cell(given: Path | None, name: str, task: Task | None) -> Path | None:
    """Return the location file for a task: the given one, else the one that the task names, else
    services.toml beside the task, one folder above it, or here; None if there is none.

    A task that comes with petrobot falls back to the location file that comes with it. `name` is
    the task as the command line names it, `task` None if it cannot be read. Raises CommandError if
    the task names a file that does not exist.
    """
    if given is not None:
        return given
    written = task_path(name)
    folders = (written.parent, written.resolve().parent)  # the task may be a symbolic link
    if task is None or not task.services:
        if written.parent == SHIPPED:
            return services_path(None)
        near = [
            os.path.normpath(folder / up / "services.toml")
            for folder in folders
            for up in (".", "..")
        ]
        return next((path for path in map(Path, (*near, "services.toml")) if path.is_file()), None)
    named = [folder / task.services for folder in folders]
    path = next((path for path in named if path.is_file()), named[0])
    if not path.is_file():
        what = f"{path} is not a file" if path.exists() else f"no such file: {path}"
        remedy = f"name one relative to {written.name}, drop the key, or give --services FILE"
        raise CommandError(
            2, f"{file_line(written, 'task.services')}: task.services: {what}; {remedy}"
        )
    return path


def cell_finder(given: Path | None, name: str) -> Callable[[Task], Cell | None]:
    """Return how a task gets its cell: that of the location file of `find_cell`, None if there is
    none. Raises CommandError."""
    if given is not None and task_path(name).suffix != ".toml":
        why = "a net file has no actions, so no location file concerns it; leave it out"
        raise CommandError(2, f"--services: {name}: {why}")

    def of(task: Task) -> Cell | None:
        path = find_cell(given, name, task)
        return None if path is None else cell_of(load_directory(path))

    return of


def objections(task: Task, cell: Cell, judged: MayRun | None = None) -> list[str]:
    """Return what the state space shows against running the task, a line for each.

    The search takes seconds, so its answer is kept in the cache of the user, under a hash of all
    that it depends on. `judged`: it was just searched.
    """
    from petrobot.coordinator.analysis import may_run
    from petrobot.coordinator.task.file import dumps

    package = Path(__file__).parents[1]
    searching = [
        f for part in ("analysis", "engine", "task") for f in (package / part).rglob("*.py")
    ]
    changed = max(file.stat().st_mtime_ns for file in searching)
    devices = sorted((cell.devices or {}).items())
    asked = repr((dumps(task.flat), task.name, devices, may_run.BUDGET, changed))
    kept = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache")
    kept = kept / "petrobot" / f"{hashlib.sha256(asked.encode()).hexdigest()[:32]}.json"
    with suppress(RuntimeError):  # this user has no home
        kept = kept.expanduser()
    if judged is None:
        try:
            return list(json.loads(kept.read_text(encoding="utf-8")))
        except (OSError, ValueError):
            with told_if_slow(f"{task.name}: searching its states"):
                judged = may_run.may_run(task, cell, may_run.BUDGET)
    found = judged.objections()
    if judged.analysis is not None and not judged.analysis.interrupted and kept.is_absolute():
        with suppress(OSError):
            make_folder(kept.parent)
            write_whole(kept, json_text(found))
            for old in sorted(kept.parent.glob("*.json"), key=os.path.getmtime)[:-KEPT_ANSWERS]:
                old.unlink()
    return found


@contextmanager
def told_if_slow(what: str) -> Iterator[None]:
    """Say in the terminal what takes longer than SLOW."""
    timer = Timer(SLOW, print, (f"{what} ...",), {"file": sys.stderr})
    if sys.stderr.isatty():
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


def file_line(path: Path, key: str) -> str:
    """Return FILE:LINE of a key of a TOML file."""
    from petrobot.services.host.toml_text import key_lines, line_of

    return f"{path}:{line_of(key, key_lines(path.read_text(encoding='utf-8')))}"


def load_directory(given: Path | None, dry_run: bool = False) -> Directory:
    """Read services.toml; with `dry_run` all drives of this host are to stay off, and a driver that
    cannot do without them is refused."""
    from petrobot.services.comm.location_file import load

    path = services_path(given)
    with file_of(path, "give --services a location file that can be read"):
        directory = load(path, dry_run)
    if dry_run:
        from petrobot.services.comm.location_file import read_text
        from petrobot.services.comm.location_file.code import code_faults, read_code

        if faults := code_faults(directory, read_code(directory), read_text(path)):
            raise CommandError(2, "\n".join(faults))
    return directory


def tell_of_demo(given: Path | None, directory: Directory, remedy: str = "") -> None:
    """Say that a command without a location file concerns the shipped cell, not the user's, and
    what to do; `remedy` is added to it."""
    if given is None and directory.source.resolve() == SHIPPED_CELL:
        print(
            "no services.toml in this folder: this concerns only the catching cell that comes with "
            f"petrobot. For your robot give --services FILE{remedy}",
            file=sys.stderr,
        )


def add_dry_run_argument(parser: argparse.ArgumentParser) -> None:
    """Add `--dry-run`."""
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="keep all drives off: drivers obey as usual, and nothing moves",
    )


def refuse_misplaced(
    directory: Directory, *, everywhere: bool = False, scripted: bool = False
) -> None:
    """Refuse a location file that names code, keys or files that this host does not have: for
    commands that start nodes or check the file.

    `everywhere`: all nodes run on this host, whatever their address; `scripted`: actions are
    replaced (`--mock`).
    """
    from petrobot.services.comm.location_file.host_checks import misplaced

    faults = misplaced(directory, everywhere=everywhere, actions=not scripted)
    if faults:
        raise CommandError(2, "\n".join(faults))


def refuse_arguments(
    task: Task, name: str, directory: Directory, *, everywhere: bool, scripted: bool
) -> None:
    """Refuse a task whose places give arguments that their actions do not have, or lack one: as far
    as the source shows it, which takes milliseconds. `petrobot check` imports the code and finds
    more."""
    from petrobot.coordinator.task.check import in_file
    from petrobot.coordinator.task.check.code import argument_findings
    from petrobot.services.comm.location_file.host_checks import signatures
    from petrobot.services.host.toml_text import key_lines, line_of

    if scripted:
        return
    known = signatures(directory, everywhere=everywhere)
    args = {action.name: action.args for action in directory.actions.values()}
    if found := in_file(task, argument_findings(task, known, args)):
        lines = key_lines(task_path(name).read_text(encoding="utf-8"))
        told = (f"{name}:{line_of(f.key, lines)}: {f.key}: {f.text}; {f.remedy}" for f in found)
        raise CommandError(2, "\n".join(told))


def refuse_script(mock: Path | None, directory: Directory, task: Task | None = None) -> None:
    """Refuse a file of scripted actions that cannot be used with this cell, or this task."""
    from petrobot.coordinator.launch import scripted_actions

    scripted_actions(mock, directory, task)


def pictures_of(task: Task, result: Mapping[str, Any]) -> dict[str, str]:
    """Return the pictures that the task's own function draws from a result, as SVG by title.
    Raises CommandError if the function cannot be loaded."""
    if not task.pictures:
        return {}
    from petrobot.coordinator.launch import load_object

    try:
        draw = load_object(task.pictures)
    except (ImportError, AttributeError, ValueError) as fault:
        raise CommandError(
            2, f"task.pictures = {task.pictures!r}: {fault}; name a function as module:function"
        ) from fault
    return dict(draw(result))


def write_json(path: str, data: Any, give: str = "--json a file") -> None:
    """Write results as JSON; `-` is standard output. `give` names the option that says where."""
    text = json_text(data, indent=2, ensure_ascii=False) + "\n"
    if path == "-":
        print(text, end="")
        return
    with file_of(path, f"give {give} that can be written"):
        make_folder(Path(path).parent)
        write_whole(Path(path), text)
