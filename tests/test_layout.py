"""The arrows of the house: who may import whom, also inside functions; pure rooms stay pure."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TOP_LEVEL = {"coordinator", "services", "sim"}

ALLOWED: tuple[tuple[str, tuple[str, ...]], ...] = (
    # the first prefix that fits a module decides; a module may always import from its own room
    ("services.comm", ("services.comm",)),
    ("services.vision", ("services.action", "services.device", "services.comm")),
    ("services.motion", ("services.action", "services.device", "services.comm")),
    ("services.mobile", ("services.action", "services.device", "services.comm")),
    ("services", ("services",)),
    ("sim", ("services.comm",)),
    ("coordinator.net", ()),
    ("coordinator.conditions", ("coordinator.net",)),
    ("coordinator.task", ("coordinator.net", "coordinator.conditions")),
    ("coordinator.taskfile", ("coordinator.net", "coordinator.task", "coordinator.conditions")),
    ("coordinator.check", ("coordinator.net", "coordinator.task", "coordinator.conditions")),
    ("coordinator.drawing", ("coordinator.net", "coordinator.task", "coordinator.conditions")),
    (
        "coordinator.analysis",
        (
            "coordinator.net",
            "coordinator.task",
            "coordinator.conditions",
            "services.comm.compiled",
            "services.comm.whole_file",
        ),
    ),
    ("coordinator.learning", ("coordinator.net", "coordinator.task")),
    ("coordinator.engine", ("coordinator.net", "coordinator.task", "coordinator.conditions")),
    (
        "coordinator.record",
        ("coordinator.net", "coordinator.task", "coordinator.conditions", "coordinator.engine", "services.comm"),
    ),
    (
        "coordinator.mission",
        (
            "coordinator.net",
            "coordinator.task",
            "coordinator.conditions",
            "coordinator.engine",
            "coordinator.record",
            "services.comm",
        ),
    ),
    (
        "coordinator.experience",
        (
            "coordinator.net",
            "coordinator.task",
            "coordinator.conditions",
            "coordinator.engine",
            "coordinator.learning",
            "coordinator.analysis",
            "coordinator.mission.partners",
            "services.comm",
        ),
    ),
    ("coordinator.hmi", ("coordinator", "services.comm")),
    ("coordinator", ("coordinator", "services.comm")),
)
"""Modules of coordinator reach services and sim only through `services.comm`; launch loads the rest by import path."""

PURE = (
    "coordinator.net",
    "coordinator.task",
    "coordinator.conditions",
    "coordinator.engine",
    "coordinator.analysis",
    "coordinator.learning",
    "services.comm.wire",
    "services.comm.caller",
    "services.comm.callee",
    "services.motion.kinematics",
    "services.motion.trajectory",
    "services.motion.interception",
    "services.vision.location",
    "services.vision.prediction",
    "services.mobile.floor",
    "services.mobile.candidates",
    "services.mobile.detection",
    "services.mobile.line_end",
    "services.mobile.sight",
    "services.mobile.watching",
    "services.mobile.odometry",
    "services.mobile.track_map",
    "services.mobile.following",
    "services.mobile.paths",
    "services.mobile.reflectors",
    "services.mobile.wheel_drives",
)
IMPURE_IMPORTS = {"asyncio", "socket", "selectors", "subprocess", "threading", "multiprocessing", "random", "secrets"}
FORBIDDEN_IMPORTS = {"pickle", "marshal", "shelve", "dill", "cloudpickle"}
ROBOT_WORDS = {"puma", "ball", "camera", "cup", "track", "rover", "catch"}


def modules() -> Iterator[tuple[str, Path]]:
    """Every module of the house with its dotted name."""
    for top in sorted(TOP_LEVEL):
        for path in sorted((ROOT / top).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


def imports(name: str, path: Path) -> Iterator[tuple[int, str]]:
    """Line and dotted name of everything that a module imports, wherever in the file."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                base = ".".join([*package.split(".")[: len(package.split(".")) - node.level + 1], base]).rstrip(".")
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)


def within(name: str, room: str) -> bool:
    """Whether a dotted name lies in a room."""
    return name == room or name.startswith(room + ".")


MODULES = list(modules())


@pytest.mark.parametrize(("name", "path"), MODULES, ids=[name for name, _ in MODULES])
def test_arrows(name: str, path: Path) -> None:
    """No module imports what its room may not know."""
    room, allowed = next((room, allowed) for room, allowed in ALLOWED if within(name, room))
    bad = [
        f"{path.name}:{line} {target}"
        for line, target in imports(name, path)
        if target.split(".")[0] in TOP_LEVEL
        and not within(target, room)
        and not any(within(target, a) for a in allowed)
    ]
    assert not bad


@pytest.mark.parametrize(("name", "path"), MODULES, ids=[name for name, _ in MODULES])
def test_nothing_unpickled(name: str, path: Path) -> None:
    """No module loads code from data, and pure rooms have no sockets, processes or randomness of their own."""
    banned = FORBIDDEN_IMPORTS | (IMPURE_IMPORTS if any(within(name, room) for room in PURE) else set())
    assert not [f"{path.name}:{line} {t}" for line, t in imports(name, path) if t.split(".")[0] in banned]
    calls = [
        n.func.id
        for n in ast.walk(ast.parse(path.read_text()))
        if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)
    ]
    assert not {"eval", "exec"} & set(calls)


@pytest.mark.parametrize(("name", "path"), MODULES, ids=[name for name, _ in MODULES])
def test_every_module_says_its_role(name: str, path: Path) -> None:
    """A file has one role, said in its first line."""
    assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))), f"{name} has no docstring"


@pytest.mark.parametrize("name", ["coordinator", "services.comm"])
def test_general_rooms_name_no_robot(name: str) -> None:
    """Names of robots and tasks stay out of the general rooms' identifiers."""
    for module, path in MODULES:
        if not within(module, name) or within(module, "coordinator.tasks"):
            continue
        words = {
            part
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            for text in (
                getattr(node, "id", None),
                getattr(node, "attr", None),
                getattr(node, "arg", None),
                getattr(node, "name", None),
            )
            if isinstance(text, str)
            for part in text.lower().split("_")
        }
        assert not words & (ROBOT_WORDS - ({"camera"} if module == "services.comm.camera" else set())), module
