"""The arrows of the house: who may import whom, also inside functions; pure rooms stay pure."""

from __future__ import annotations

import ast
import re
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
        (
            "coordinator.net",
            "coordinator.task",
            "coordinator.conditions",
            "coordinator.engine",
            "services.comm",
        ),
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
"""Modules of coordinator reach services and sim only through `services.comm`; launch loads the rest
by import path."""

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
IMPURE_IMPORTS = {
    "asyncio",
    "socket",
    "selectors",
    "subprocess",
    "threading",
    "multiprocessing",
    "random",
    "secrets",
}
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
    own = f"petrobot.{name}"
    package = own if path.name == "__init__.py" else own.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name.removeprefix("petrobot.")) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                base = ".".join(
                    [*package.split(".")[: len(package.split(".")) - node.level + 1], base]
                ).rstrip(".")
            base = base.removeprefix("petrobot.")
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
    """No module loads code from data, and pure rooms have no sockets, processes or randomness of
    their own."""
    banned = FORBIDDEN_IMPORTS | (
        IMPURE_IMPORTS if any(within(name, room) for room in PURE) else set()
    )
    assert not [
        f"{path.name}:{line} {t}" for line, t in imports(name, path) if t.split(".")[0] in banned
    ]
    calls = [
        n.func.id
        for n in ast.walk(ast.parse(path.read_text()))
        if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)
    ]
    assert not {"eval", "exec"} & set(calls)


@pytest.mark.parametrize(("name", "path"), MODULES, ids=[name for name, _ in MODULES])
def test_every_module_says_its_role(name: str, path: Path) -> None:
    """A file has one role, said in its first line."""
    assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))), (
        f"{name} has no docstring"
    )


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
        assert not words & (
            ROBOT_WORDS - ({"camera"} if module == "services.comm.camera" else set())
        ), module


OWNED_LOOP = re.compile(r"not self\._over(\(\w+\)|\.is_set\(\))?")
"""The loop of a helper's thread or task, which its owner ends: `while not self._over.is_set()`."""
CLOCKS = {"monotonic", "time", "now"}
TESTS = [
    path
    for path in sorted((ROOT / "tests").rglob("*.py"))
    # benches run by hand, and the cell of an outside user has the deadlines of its own
    if not {"bench", "outside"} & set(path.relative_to(ROOT).parts)
]


def own_nodes(node: ast.AST) -> Iterator[ast.AST]:
    """What a statement holds, except what lies in functions that it defines."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(
            child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda | ast.ClassDef
        ):
            yield child
            yield from own_nodes(child)


def has_limit(loop: ast.While, timed: bool) -> bool:
    """Whether this loop cannot wait for ever: the rule of `test_no_wait_is_without_a_limit`."""
    inside = list(own_nodes(loop))
    names = {ast.unparse(n) for n in ast.walk(loop.test)}
    counted = {
        ast.unparse(n.target)
        for n in inside
        if isinstance(n, ast.AugAssign) and isinstance(n.value, ast.Constant)
    }
    called = {
        n.func.attr: ast.unparse(n.func.value)
        for n in inside
        if isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute)
    }
    compared = {
        name
        for n in inside
        if isinstance(n, ast.Compare)
        and any(isinstance(op, ast.Lt | ast.LtE | ast.Gt | ast.GtE) for op in n.ops)
        for part in ast.walk(n)
        for name in (ast.unparse(part), getattr(part, "attr", ""))
    }
    never_left = isinstance(loop.test, ast.Constant) and not any(
        isinstance(n, ast.Return | ast.Break) for n in inside
    )
    return (
        never_left  # no wait: the test cancels or kills it
        or (timed and any(isinstance(n, ast.Await) for n in inside))
        or "left" in called  # tests.waiting.Limit
        or bool(compared & (CLOCKS | counted))
        or any(called.get(verb) in names for verb in ("pop", "popleft"))  # empties what it looks at
        or any(
            isinstance(n, ast.NamedExpr) for n in ast.walk(loop.test)
        )  # reads its source to the end
        or OWNED_LOOP.fullmatch(ast.unparse(loop.test)) is not None
    )


def loops(node: ast.AST, timed: bool = False) -> Iterator[tuple[ast.While, bool]]:
    """Every `while` of a module, and whether it lies in an `asyncio.timeout` of its own
    function."""
    for child in ast.iter_child_nodes(node):
        inner = timed and not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
        if isinstance(child, ast.AsyncWith):
            inner = inner or any(
                "timeout" in ast.unparse(item.context_expr) for item in child.items
            )
        if isinstance(child, ast.While):
            yield child, inner
        yield from loops(child, inner)


def test_no_wait_is_without_a_limit() -> None:
    """Every `while` of the tests has a limit: of time, of steps, or the end of what it reads.

    A test that waits for ever cannot fail, so it shows nothing. Remedy: `tests.waiting.Limit`.
    """
    unlimited = [
        f"{path.relative_to(ROOT)}:{loop.lineno}: while {ast.unparse(loop.test)}"
        for path in TESTS
        for loop, timed in loops(ast.parse(path.read_text(encoding="utf-8")))
        if not has_limit(loop, timed)
    ]
    assert not unlimited, "\n".join(["no limit (use tests.waiting.Limit):", *unlimited])


@pytest.mark.parametrize(
    ("source", "limited"),
    [
        ("while not ready(): step()", False),
        ("while True:\n if ready(): break", False),
        ("while len(got) < 3: got += read()", False),
        ("while not ready() and limit.left(): step()", True),
        ("while not ready():\n assert time.monotonic() < end", True),
        ("while tries < 5: tries += 1", True),
        ("while queue: visit(queue.popleft())", True),
        ("while data := read(): keep(data)", True),
        ("while True: serve()", True),
    ],
)
def test_the_rule_of_limits_tells_waits_apart(source: str, limited: bool) -> None:
    """What the rule above refuses and what it lets pass."""
    (loop,) = ast.parse(source).body
    assert isinstance(loop, ast.While) and has_limit(loop, timed=False) is limited
