"""The wheel in an environment that has packages called `services` and `coordinator`, in a folder
with `services/`, `sim/` and `tests/` of its own: every command of the README works there."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
import venv
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from msgspec import Struct
from msgspec.structs import replace

from tests.cli.test_new import on_free_port
from tests.integration.cell_files import services_file
from tests.waiting import Limit

pytestmark = [pytest.mark.processes, pytest.mark.long]
ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = [
    line.split("  #")[0].strip()
    for block in README.split("```")[1::2]
    for line in block.splitlines()
    if line.startswith(("petrobot ", "cd "))
]
ENDS = {"petrobot resume last": (0, 1)}
"""Exit codes where they are not 0 alone: `resume` of a finished run repeats how it ended."""
FOREIGN = 'raise ImportError("the wrong package was imported")\n'
LIMIT = 300.0


class Installed(Struct):
    """An environment with the wheel, and a folder of a user."""

    python: Path
    folder: Path

    def run(self, command: str) -> subprocess.CompletedProcess[str]:
        """Run a command of the README in the user's folder, with few repetitions."""
        few = re.sub(r"--runs \d+", "--runs 1", command)
        return subprocess.run(
            [self.python.with_name("petrobot"), *shlex.split(few)[1:]],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=LIMIT,
            check=False,
        )

    @property
    def environment(self) -> dict[str, str]:
        """Without what would let this checkout be found."""
        return {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}


@pytest.fixture(scope="module")
def installed(shared: Callable[..., Path]) -> Installed:
    """The environment and the folder; both tests use one, perhaps in two processes."""
    base = shared("installed", install)
    return Installed(base / "env" / "bin" / "python", base / "robot")


def install(base: Path) -> None:
    """Build the wheel from a copy, and install it beside foreign packages of the old names."""
    copy = base / "source"
    left_out = (".*", "build", "*.egg-info", "reports", "runs", "tests", "tools", "docs")
    shutil.copytree(ROOT, copy, symlinks=True, ignore=shutil.ignore_patterns(*left_out))
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    build = ["wheel", "--no-deps", "--no-build-isolation", "-w", str(base), str(copy)]
    subprocess.run([*pip, *build], check=True, timeout=LIMIT)
    (wheel,) = base.glob("petrobot-*.whl")
    venv.create(base / "env", with_pip=False)
    python = base / "env" / "bin" / "python"
    install = ["--python", str(python), "install", "--no-deps", "--no-index", str(wheel)]
    subprocess.run([*pip, *install], check=True, timeout=LIMIT)
    (site,) = (base / "env" / "lib").glob("python*/site-packages")
    # The dependencies are those of this environment; a path in a .pth file brings no checkout with
    # it, since .pth files there are not read again.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
    for where in (site, base / "robot"):
        for name in ("services", "coordinator", "sim", "tests"):
            (where / name).mkdir(parents=True)
            (where / name / "__init__.py").write_text(FOREIGN, encoding="utf-8")


def test_nothing_of_this_checkout_is_imported(installed: Installed) -> None:
    where = "import petrobot.coordinator.cli as c; print(c.__file__)"
    said = subprocess.run(
        [installed.python, "-c", where],
        cwd=installed.folder,
        env=installed.environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert Path(said.stdout.strip()).is_relative_to(installed.python.parents[1])


@pytest.mark.timeout(900)  # some thirty commands, each with a limit of its own
def test_every_command_of_the_readme(installed: Installed) -> None:
    """In its order; the first run takes the location file that the wheel brings along."""
    assert len(COMMANDS) >= 16 and COMMANDS[0].startswith("petrobot run catch_ball --mode lockstep")
    _try(installed, COMMANDS[0])
    services_file(installed.folder)  # from now on on ports that no other test uses
    user = replace(installed)
    for command in COMMANDS[1:]:
        if command.startswith("cd "):
            user.folder = (user.folder / command.removeprefix("cd ")).resolve()
            if user.folder != installed.folder:
                on_free_port(user.folder)
        elif command == "petrobot up":
            with _staying(installed, command) as said:
                _until(said, "Ctrl-C stops them all")
                _try(installed, "petrobot nodes")
        elif command == "petrobot serve --up":
            with _staying(installed, command) as said:
                _until(said, "http://")
        elif command != "petrobot nodes":  # tried while they were up
            _try(user, command)


def _try(installed: Installed, command: str) -> None:
    done = installed.run(command)
    said = f"{command}: {done.stdout}{done.stderr}"
    assert done.returncode in ENDS.get(command, (0,)), said
    assert "Traceback" not in said


def _until(said: Path, text: str) -> None:
    limit = Limit(text)
    while text not in said.read_text(encoding="utf-8") and limit.left():
        time.sleep(0.1)


@contextmanager
def _staying(installed: Installed, command: str) -> Iterator[Path]:
    """Run a command until the end of the block, then press Ctrl-C; gives what it prints."""
    said = installed.folder / "said.txt"
    with said.open("w", encoding="utf-8") as output:
        process = subprocess.Popen(
            [installed.python.with_name("petrobot"), *shlex.split(command)[1:]],
            cwd=installed.folder,
            env=installed.environment,
            stdout=output,
            stderr=output,
        )
        try:
            yield said
            process.send_signal(signal.SIGINT)
            assert process.wait(LIMIT) in (0, 130), said.read_text(encoding="utf-8")
        finally:
            process.kill()
            process.wait()
