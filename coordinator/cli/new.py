"""Write a working skeleton with its test: of a whole robot (a folder that runs), of an action or a
driver (a Python file), or of a task (a net of one action with an error branch). Or copy one of the
examples of the pages."""

from __future__ import annotations

import argparse
import importlib.util
import keyword
import re
from pathlib import Path

from petrobot.coordinator.cli import CommandError, file_of
from petrobot.coordinator.cli.loading import SHIPPED_CELL
from petrobot.services.host.whole_file import make_folder, write_whole

EXAMPLE = "petrobot new robot carrier"
EXAMPLES = Path(__file__).parents[2] / "examples"
"""The robots of the pages, each a folder of its own."""
NAMED_CELL = '"../../services.toml"'
SKELETONS = Path(__file__).with_name("skeletons")
"""The files that are written, with {name}, {module} and {Class} in place of these."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("what", choices=("robot", "driver", "action", "task", "example"))
    parser.add_argument(
        "name",
        help="its name, such as close_gripper; an example of these pages is copied: "
        + ", ".join(_examples()),
    )
    parser.add_argument(
        "--folder", type=Path, default=Path(), help="folder to write to (default: this folder)"
    )


def _examples() -> list[str]:
    return sorted(path.name for path in EXAMPLES.iterdir() if path.is_dir())


def run(options: argparse.Namespace) -> int:
    """Write the files. Existing files are never overwritten."""
    name, folder = options.name, options.folder
    if keyword.iskeyword(name):
        raise CommandError(2, f"{name!r} is a keyword of Python: choose another name")
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise CommandError(
            2,
            f"{name!r} cannot be the name: use small letters, digits and _, a letter first",
        )
    makers = {
        "robot": _robot,
        "driver": _driver,
        "action": _action,
        "task": _task,
        "example": _example,
    }
    files, hint = makers[options.what](name, folder)
    _write(files)
    print("\n".join([*(f"wrote {path}" for path in files), hint]))
    return 0


def _robot(name: str, folder: Path) -> tuple[dict[Path, str], str]:
    _refuse_hidden(name, folder / name / f"{name}.py")
    project = folder / name
    code = skeleton("driver.py.txt", "slide") + skeleton("robot_actions.py.txt", name)
    code = code.replace("The device slide: say here what it is.", f"The robot {name}.")
    code = code.replace(
        "import Axis\n", "import Axis, Context, Remote, Result, error, success\n", 1
    )
    texts = {
        "pyproject.toml": "robot_pyproject.toml",
        "services.toml": "robot_services.toml",
        f"{name}.toml": "robot.toml",
        f"test_{name}.py": "test_robot.py.txt",
    }
    files = {project / file: skeleton(text, name) for file, text in texts.items()}
    hint = (
        f"cd {project}, then:\n  petrobot check {name}.toml\n"
        f"  petrobot run {name}.toml --mode lockstep   # simulated time\n"
        f"  petrobot run {name}.toml --up              # real time\n"
        "  pytest                                # first: pip install pytest"
    )
    return {project / f"{name}.py": code, **files}, hint


def _driver(name: str, folder: Path) -> tuple[dict[Path, str], str]:
    module, paths = _python(name, folder)
    texts = (skeleton(f, name, module) for f in ("driver.py.txt", "test_driver.py.txt"))
    hint = (
        "place it in services.toml, under [devices]:\n"
        f'  {name} = {{ node = "...", driver = "{module}:{_class(name)}" }}'
    )
    return dict(zip(paths, texts, strict=True)), hint


def _action(name: str, folder: Path) -> tuple[dict[Path, str], str]:
    module, paths = _python(name, folder)
    texts = (skeleton(f, name, module) for f in ("action.py.txt", "test_action.py.txt"))
    hint = (
        "place it in services.toml, under [actions]:\n"
        f'  {name} = {{ run = "{module}:{name}", node = "..." }}'
    )
    return dict(zip(paths, texts, strict=True)), hint


def _task(name: str, folder: Path) -> tuple[dict[Path, str], str]:
    files = {
        folder / f"{name}.toml": skeleton("task.toml", name),
        folder / f"test_{name}.py": skeleton("test_task.py.txt", name),
    }
    stand_in = "petrobot.services.scripted:nothing"  # it does nothing, and succeeds
    lines = [f'  {a} = {{ run = "{stand_in}", node = "..." }}' for a in ("work", "recover")]
    hint = "\n".join(
        (
            f"draw it: petrobot show {folder / name}.toml --errors --out {name}.svg",
            "to check and run it, place its actions in services.toml, under [actions]; these do",
            "nothing until you write your own (petrobot new action):",
            *lines,
        )
    )
    return files, hint


def _example(name: str, folder: Path) -> tuple[dict[Path, str], str]:
    if name not in _examples():
        raise CommandError(2, f"no example {name!r}; there are: {', '.join(_examples())}")
    paths = sorted(path for path in (EXAMPLES / name).iterdir() if path.is_file())
    # A task that names the cell of the catching task finds it from its new folder, too.
    there = f'"{SHIPPED_CELL}"'
    files = {
        folder / name / path.name: path.read_text(encoding="utf-8").replace(NAMED_CELL, there)
        for path in paths
    }
    tasks = [path.name for path in paths if path.suffix == ".toml" and path.stem != "services"]
    return files, f"next: cd {folder / name}; petrobot check {tasks[0]}"


def _python(name: str, folder: Path) -> tuple[str, tuple[Path, Path]]:
    """The import name of a new module in a package `folder`, its file and that of its test."""
    if not folder.name:
        _refuse_hidden(name, Path(f"{name}.py"))
        return name, (Path(f"{name}.py"), Path(f"test_{name}.py"))
    if not folder.name.isidentifier() or keyword.iskeyword(folder.name):
        text = f"--folder {folder}: {folder.name!r} cannot be the name of a package of Python"
        raise CommandError(2, f"{text}; use letters, digits and _")
    _refuse_hidden(folder.name, folder)
    return f"{folder.name}.{name}", (folder / f"{name}.py", folder.parent / f"test_{name}.py")


def _refuse_hidden(name: str, path: Path) -> None:
    """Refuse a module or package `path` if Python already has another one of this name."""
    spec = importlib.util.find_spec(name)
    if spec is None:
        return
    known = [
        Path(one).resolve()
        for one in (spec.origin, *(spec.submodule_search_locations or ()))
        if one
    ]
    if path.resolve() not in known:
        text = f"a Python module named {name!r} is there already and would hide {path}"
        raise CommandError(2, f"{text}; choose another name")


def _class(name: str) -> str:
    return "".join(word.capitalize() for word in name.split("_"))


def skeleton(file: str, name: str, module: str = "") -> str:
    """Return the text of a file of SKELETONS for this name."""
    text = (SKELETONS / file).read_text(encoding="utf-8")
    for word, filled in (("name", name), ("module", module), ("Class", _class(name))):
        text = text.replace(f"{{{word}}}", filled)
    return text


def _write(files: dict[Path, str]) -> None:
    for path in files:
        if path.exists():
            raise CommandError(2, f"{path} exists already; choose another name or --folder")
    for path, text in files.items():
        with file_of(path, "give --folder one that can be written"):
            make_folder(path.parent)
            write_whole(path, text)
