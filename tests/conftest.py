"""Settings of all tests: property tests judge results, never wall-clock time; no test hangs; who
starts processes says so."""

from __future__ import annotations

import atexit
import fcntl
import gc
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

import petrobot  # noqa: F401 - first of all imports, as in petrobot's processes: numpy comes after it

settings.register_profile(
    "petrobot", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True
)
settings.load_profile("petrobot")

# A background job of a shell ignores Ctrl-C, and so would each process that a test starts.
signal.signal(signal.SIGINT, signal.default_int_handler)

PROOF_LIMIT_S = 6 * 3600.0
"""The limit of one test marked `proof` (s); the others have `timeout` of pyproject.toml."""

_started: list[str] = []
"""What this test has started as processes."""


os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="petrobot-cache-")  # not the user's
atexit.register(shutil.rmtree, os.environ["XDG_CACHE_HOME"], ignore_errors=True)


def _note_start(event: str, arguments: tuple[Any, ...]) -> None:
    if event in ("subprocess.Popen", "os.fork", "os.posix_spawn"):
        _started.append(f"{event}{arguments[:2]}")


sys.addaudithook(_note_start)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collect without the garbage collector, which finds nothing and takes a third of the time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


def pytest_collection_finish() -> None:
    """Keep what was imported and collected out of the garbage collector's full passes.

    A pass over all of it takes more than a second, in which a test answers no node: the node then
    takes its caller for lost. No pass comes first: it would take a quarter of the collection.
    """
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the long tests: begun last, one of them keeps the other cores idle. Give each
    proof the limit of proofs, unless it has a limit of its own; a browser is a process, too."""
    items.sort(key=lambda item: item.get_closest_marker("long") is None)
    for item in items:
        if isinstance(item, pytest.Function) and "browser" in item.fixturenames:
            item.add_marker("processes")
            item.add_marker("browser")
        if item.get_closest_marker("proof") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(PROOF_LIMIT_S))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol() -> Iterator[None]:
    """Each test counts its own processes, those of its fixtures among them."""
    _started.clear()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Iterator[None]:
    """A test that starts processes is marked so: those are repeated on a busy machine."""
    yield
    assert not _started or item.get_closest_marker("processes"), (
        f"mark it `processes`: it starts {_started[0]}"
    )


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Make a folder once for all workers of a session, where that is expensive:
    `shared("name", make)` calls `make(folder)` in the first process that asks, while others wait.
    No test may change what it holds."""
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent

    def made(name: str, make: Callable[[Path], object]) -> Path:
        folder, done = base / f"shared-{name}", base / f"shared-{name}.done"
        with (base / f"shared-{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # the kernel frees it if this process is killed
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                done.touch()
        return folder

    return made
