"""How commands find their files: the task, services.toml, and where results go."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.services.host.json_text import json_text
from petrobot.services.host.whole_file import make_folder, write_whole

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

    from petrobot.coordinator.task import Task
    from petrobot.services.comm.location_file import Directory

SHIPPED = Path(__file__).parents[1] / "tasks"
"""Tasks that come with petrobot; they are known by their bare names."""
SHIPPED_CELL = (Path(__file__).parents[2] / "services.toml").resolve()
"""The location file that comes with petrobot: that of the catching cell."""
NODE_LOGS = Path("runs/logs")
"""Where the commands that start nodes keep their logs, a file each."""
OWN = Path("tasks")
"""Where the operator's page saves tasks: beside what one works on."""


def add_services_argument(parser: argparse.ArgumentParser) -> None:
    """`--services FILE`, the same for all commands."""
    parser.add_argument(
        "--services",
        metavar="FILE",
        type=Path,
        help="the location file (default: the one that the task names in `services`, where "
        "there is a task that does, "
        "else services.toml here, else the one that comes with petrobot)",
    )


def task_path(name: str) -> Path:
    """The file of a task given by path, or by its bare name: one's own in `tasks` here, else a
    shipped one."""
    path = Path(name)
    if path.suffix == ".toml" or path.is_file():
        return path
    own = OWN / f"{name}.toml"
    if own.exists():
        return own
    shipped = SHIPPED / f"{name}.toml"
    if shipped.exists():
        return shipped
    known = ", ".join(sorted(p.stem for p in SHIPPED.glob("*.toml")))
    raise CommandError(
        2, f"no task {name!r}: give a .toml file, or one of those that come with petrobot: {known}"
    )


def load_task(name: str) -> Task:
    """Read a task file."""
    from petrobot.coordinator.task.file import TaskFileError, load

    path = task_path(name)
    try:
        return load(path)
    except OSError as fault:
        raise CommandError(2, f"{path}: {fault.strerror or fault}") from fault
    except TaskFileError as fault:
        raise CommandError(2, str(fault)) from fault


def services_path(given: Path | None) -> Path:
    """services.toml: the given one, the one here, or the shipped one."""
    if given is not None:
        return given
    here = Path("services.toml")
    return here if here.exists() else SHIPPED_CELL


def cell_path(given: Path | None, name: str, task: Task) -> Path:
    """services.toml for a task, which was named so on the command line: the given one, the task's
    own, or the one at hand.

    Raises CommandError where the task names a file that is not there.
    """
    if given is not None or not task.services:
        return services_path(given)
    written = task_path(name)
    path = written.parent / task.services
    if not path.is_file():
        what = f"{path} is no file" if path.exists() else f"no such file: {path}"
        remedy = f"name one relative to {written.name}, drop the key, or give --services FILE"
        raise CommandError(
            2, f"{file_line(written, 'task.services')}: task.services: {what}; {remedy}"
        )
    return path


def file_line(path: Path, key: str) -> str:
    """FILE:LINE of a key of a TOML file."""
    from petrobot.coordinator.task.file.errors import key_lines, line_of

    return f"{path}:{line_of(key, key_lines(path.read_text(encoding='utf-8')))}"


def load_directory(given: Path | None) -> Directory:
    """Read services.toml."""
    from petrobot.services.comm.location_file import DirectoryError, load

    path = services_path(given)
    try:
        return load(path)
    except OSError as fault:
        text = (
            f"{path}: {fault.strerror or fault}; give --services a location file that can be read"
        )
        raise CommandError(2, text) from fault
    except DirectoryError as fault:
        raise CommandError(2, str(fault)) from fault


def refuse_misplaced(
    directory: Directory, *, everywhere: bool = False, scripted: bool = False
) -> None:
    """Refuse a location file that names code, keys or files which this host has not: for commands
    that launch nodes or judge it.

    `everywhere`: all nodes are launched here, wherever they belong; `scripted`: actions are
    replaced (`--mock`).
    """
    from petrobot.services.comm.location_file.host_checks import misplaced

    faults = misplaced(directory, everywhere=everywhere, actions=not scripted)
    if faults:
        raise CommandError(2, "\n".join(faults))


def refuse_script(mock: Path | None, directory: Directory) -> None:
    """Refuse a file of scripted actions that cannot be used with this cell."""
    from petrobot.coordinator.launch import RequestError, scripted_actions

    try:
        scripted_actions(mock, directory)
    except RequestError as fault:
        raise CommandError(2, str(fault)) from fault


def pictures_of(task: Task, result: Mapping[str, Any]) -> dict[str, str]:
    """What the task's own function draws of a mission run's result, SVG by title. Raises
    CommandError when it cannot be had."""
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


def write_json(path: str, data: Any) -> None:
    """Write results as JSON; `-` is standard output."""
    text = json_text(data, indent=2, ensure_ascii=False) + "\n"
    if path == "-":
        print(text, end="")
        return
    try:
        make_folder(Path(path).parent)
        write_whole(Path(path), text)
    except OSError as fault:
        raise CommandError(
            2, f"{path}: {fault.strerror or fault}; give --json a file that can be written"
        ) from fault
