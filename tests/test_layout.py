"""Which folder may import which, also inside functions; folders without side effects stay so."""

from __future__ import annotations

import ast
import gc
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import pytest
from tools.proof.mutations import COPIED, MUTATIONS

pytestmark = pytest.mark.once

ROOT = Path(__file__).parents[1]
TOP_LEVEL = {"coordinator", "services", "sim"}

STORED = tuple(
    f"coordinator.learning.{name}"
    for name in (
        "estimates_file",
        "estimates_tables",
        "learner",
        "session",
        "propagation",
        "trial_tokens",
        "waits",
    )
)
"""What learning keeps on disk and gets from runs; the rest of the room is pure."""

ALLOWED: tuple[tuple[str, tuple[str, ...]], ...] = (
    # The first prefix that fits a module decides. A module may always import from its own room.
    ("services.host", ()),
    ("services.comm", ("services.host",)),
    *(
        (
            room,
            (
                "services.action",
                "services.device",
                "services.camera",
                "services.perform",
                "services.comm",
                "services.host",
            ),
        )
        for room in ("services.vision", "services.motion", "services.mobile")
    ),
    # What a user writes: an adapter reaches petrobot by its public API alone.
    ("services.adapters", ()),
    ("services", ("services",)),
    ("sim", ("services.comm", "services.host")),
    ("coordinator.task.net", ()),
    ("coordinator.task.conditions", ("coordinator.task.net", "coordinator.task.wording")),
    ("coordinator.task", ("services.host.toml_text",)),
    ("coordinator.drawing", ("coordinator.task",)),
    ("coordinator.engine", ("coordinator.task",)),
    (
        "coordinator.analysis",
        (
            "coordinator.task",
            "coordinator.engine",
            "services.host.numba_kernels",
            "services.host.toml_text",
            "services.host.whole_file",
        ),
    ),
    *(
        (
            stored,
            (
                "coordinator.learning",
                "coordinator.task",
                "coordinator.engine",
                "coordinator.analysis",
                "coordinator.run.interfaces",
                "services.comm",
                "services.host",
            ),
        )
        for stored in STORED
    ),
    ("coordinator.learning", ("coordinator.task",)),
    (
        "coordinator.run",
        ("coordinator.task", "coordinator.engine", "services.comm", "services.host"),
    ),
    ("coordinator", ("coordinator", "services.comm", "services.host")),
)
"""Modules of coordinator reach services and sim only through `services.comm` and `services.host`;
launch loads the rest by import path."""

PURE = (
    "coordinator.task",
    "coordinator.engine",
    "coordinator.analysis",
    "coordinator.learning",
    "services.comm.protocol.messages",
    "services.comm.protocol.codec",
    "services.comm.protocol.plain",
    "services.comm.protocol.wire",
    "services.comm.calls.caller",
    "services.comm.calls.callee",
    "services.comm.calls.peers",
    "services.comm.calls.events",
    "services.motion.kinematics",
    "services.motion.trajectory",
    "services.motion.interception",
    "services.vision.location",
    "services.vision.prediction",
    "services.mobile.detection",
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
ROBOT_WORDS = {"throw", "throws", "puma", "ball", "camera", "cup", "track", "rover", "catch"}


def modules() -> Iterator[tuple[str, Path]]:
    """Every module of the source with its dotted name."""
    for top in sorted(TOP_LEVEL):
        for path in sorted((ROOT / top).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


def imports(name: str, path: Path, nodes: list[ast.AST]) -> Iterator[tuple[int, str]]:
    """Line and dotted name of everything that a module imports, wherever in the file."""
    own = f"petrobot.{name}"
    package = own if path.name == "__init__.py" else own.rpartition(".")[0]
    for node in nodes:
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


def trees(paths: Iterable[Path]) -> dict[Path, ast.Module]:
    """The syntax trees of files. The garbage collector would find nothing and take four fifths of
    the time."""
    gc.disable()
    try:
        return {path: ast.parse(path.read_text(encoding="utf-8")) for path in paths}
    finally:
        gc.enable()


@cache
def parsed() -> list[tuple[str, Path, list[ast.AST]]]:
    """Every module with the nodes of its syntax tree, the module itself first. Not while tests are
    collected: each process does that."""
    found = trees(path for _, path in modules())
    return [(name, path, list(ast.walk(found[path]))) for name, path in modules()]


@cache
def parsed_tests() -> dict[Path, ast.Module]:
    """Every file of `TESTS` with its syntax tree."""
    return trees(TESTS)


def test_no_module_imports_what_its_room_may_not_know() -> None:
    """The arrows of `ALLOWED`."""
    wrong = []
    for name, path, nodes in parsed():
        room, allowed = next((room, allowed) for room, allowed in ALLOWED if within(name, room))
        wrong += [
            f"{path.relative_to(ROOT)}:{line}: {target}"
            for line, target in imports(name, path, nodes)
            if target.split(".")[0] in TOP_LEVEL
            and not any(within(target, known) for known in (room, *allowed))
        ]
    assert not wrong, "\n".join(wrong)


def test_only_one_module_imports_pybullet() -> None:
    """All others run where there is no wheel of it."""
    found = [
        name
        for name, path, nodes in parsed()
        if any(target.startswith("pybullet") for _, target in imports(name, path, nodes))
    ]
    assert found == ["sim.catching.bullet"]


def test_pure_rooms_stay_pure_and_nothing_is_unpickled() -> None:
    """No module loads code from data; pure rooms have no socket, process or randomness."""
    wrong = []
    for name, path, nodes in parsed():
        pure = name not in STORED and any(within(name, room) for room in PURE)
        banned = FORBIDDEN_IMPORTS | (IMPURE_IMPORTS if pure else set())
        where = path.relative_to(ROOT)
        wrong += [
            f"{where}:{n}: {t}" for n, t in imports(name, path, nodes) if t.split(".")[0] in banned
        ]
        wrong += [
            f"{where}:{node.lineno}: {node.func.id}"
            for node in nodes
            if isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id in ("eval", "exec")
        ]
    assert not wrong, "\n".join(wrong)


def test_every_module_says_its_role() -> None:
    """The first line of a file says what it is for."""
    silent = [
        str(path.relative_to(ROOT))
        for _, path, (module, *_) in parsed()
        if isinstance(module, ast.Module) and not ast.get_docstring(module)
    ]
    assert not silent


def test_general_rooms_name_no_robot() -> None:
    """Names of robots and their tasks stay out of the general rooms' identifiers."""
    wrong = []
    for name, path, nodes in parsed():
        if not any(within(name, room) for room in ("coordinator", "services.comm")):
            continue
        allowed = {"camera"} if name == "services.comm.streams.camera" else set()
        for node in nodes:
            for kind in ("id", "attr", "arg", "name"):
                text = getattr(node, kind, None)
                if isinstance(text, str) and set(text.lower().split("_")) & ROBOT_WORDS - allowed:
                    wrong.append(f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}: {text}")
    assert not wrong, "\n".join(wrong)


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
        for path, tree in parsed_tests().items()
        for loop, timed in loops(tree)
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


ASSERTING = {"raises", "warns", "fail", "expect", "left"}
"""What fails by itself: of pytest, of Playwright, and of `tests.waiting.Limit`."""


def called(node: ast.AST) -> set[str]:
    """Return the names of all functions that are called or passed on in it."""
    return {
        str(getattr(part, "attr", "") or getattr(part, "id", ""))
        for n in ast.walk(node)
        if isinstance(n, ast.Call)
        for part in (n.func, *n.args)
    }


def asserts(function: ast.AST) -> bool:
    """Whether a function has an assertion of its own."""
    return any(
        isinstance(n, ast.Assert) or (isinstance(n, ast.Raise) and "Error" in ast.unparse(n))
        for n in ast.walk(function)
    ) or bool(called(function) & ASSERTING)


def functions(tree: ast.Module) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Every function of a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def test_every_test_asserts_something() -> None:
    """Each test asserts, or calls a helper of the tests that does: else it only shows that nothing
    raises."""
    found = {
        path: [(f, asserts(f)) for f in functions(tree)] for path, tree in parsed_tests().items()
    }
    helpers = {f.name for pairs in found.values() for f, does in pairs if does}
    idle = []
    for path, pairs in found.items():
        others = {f.name for f, does in pairs if not does}
        idle += [
            f"{path.relative_to(ROOT)}:{test.lineno}: {test.name}"
            for test, does in pairs
            if test.name.startswith("test_") and not does and not called(test) & helpers - others
        ]
    assert not idle, "\n".join(["no assertion:", *idle])


@pytest.mark.parametrize(
    ("source", "asserting"),
    [
        ("def f(): assert x", True),
        ("def f():\n with pytest.raises(E): x()", True),
        ("def f(): raise AssertionError", True),
        ("def f(): x()", False),
        ("def f(): raise", False),
    ],
)
def test_the_rule_of_assertions_tells_functions_apart(source: str, asserting: bool) -> None:
    """What the rule above takes for an assertion."""
    assert asserts(ast.parse(source)) is asserting


def test_mutations_are_judged_in_a_copy_of_all_that_tests_read() -> None:
    """Else tests fail there for want of a folder, and every fault counts as noticed."""
    texts = [path.read_text(encoding="utf-8") for path in TESTS]
    read = {name for text in texts for name in re.findall(r'\bROOT / "([\w.]+)"', text)}
    assert {name for name in read if (ROOT / name).exists()} <= set(COPIED)


def test_every_mutation_still_finds_its_text() -> None:
    """Else the next run of `tools.proof.mutations` stops there, long after the change."""
    lost = [
        f"{one.file}: {one.name}"
        for one in MUTATIONS
        if (ROOT / one.file).read_text(encoding="utf-8").count(one.old) != 1
    ]
    assert not lost, "\n".join(["expected its text once:", *lost])


@pytest.mark.processes
@pytest.mark.parametrize(
    ("module", "late"),
    [
        ("services.worker.process", ("numpy", "scipy", "asyncio")),
        ("services.__main__", ("numpy", "scipy")),
        ("coordinator.operator.prepare", ("scipy", "aiohttp", "rich")),
        ("coordinator.operator.start_from", ("numpy", "scipy", "aiohttp", "rich")),
        ("coordinator.studies.report.campaign_page", ("scipy",)),
        ("coordinator.cli", ("numpy", "scipy", "asyncio", "rich", "aiohttp")),
    ],
)
def test_what_starts_often_imports_late(module: str, late: tuple[str, ...]) -> None:
    """Each worker, node and command pays for what its program imports: numpy takes as long as all
    the rest of a worker, scipy longer. They are imported where they are used."""
    look = f"import sys, petrobot.{module}; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", look],
        env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        check=True,
    )
    assert set(late).isdisjoint(done.stdout.split())


@pytest.mark.processes
@pytest.mark.parametrize(("given", "said"), [({}, "1 1"), ({"OPENBLAS_NUM_THREADS": "2"}, "2 ")])
def test_numpy_has_one_thread_unless_the_user_gives_more(given: dict[str, str], said: str) -> None:
    """Threads of OpenBLAS wait in busy loops and take the cores from other processes."""
    look = (
        "import os, petrobot, numpy; "
        "print(os.environ['OPENBLAS_NUM_THREADS'], len(os.listdir('/proc/self/task')))"
    )
    others = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    done = subprocess.run(
        [sys.executable, "-c", look],
        env={**others, "PYTHONPATH": str(ROOT / "src"), **given},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.startswith(said)
