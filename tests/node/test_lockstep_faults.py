"""Lock step reports faults of drivers as real time does, and names code that does not return."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path
from typing import Any

import pytest

from petrobot.services.comm.location_file import ActionEntry
from petrobot.services.comm.protocol.messages import Answer, Call, Command, Outcome
from petrobot.services.node import watchdog
from petrobot.services.node.inline_host import InlineHost
from petrobot.services.node.watchdog import Watchdog
from tests.node.conftest import OUTSIDE, Clock
from tests.node.test_driver_faults import FAULTS
from tests.node.test_processes import PATIENCE, ROOT
from tests.ports import free_ports

TICK = 0.004


class Ports:
    """Ports with events only."""

    now = 0.0

    def raise_event(self, name: str, **data: Any) -> None:
        from petrobot.services.comm.protocol.messages import Event
        from petrobot.services.worker.context import checked

        checked(Event(name, "it", 1, data))


class Inline:
    """A worker in this process, with a driver that breaks."""

    def __init__(self, breaks: str, action: str = "order") -> None:
        from toy_cell import actions, drivers  # type: ignore[import-not-found]  # tests/node/outside

        self.clock = Clock()
        self.driver = drivers.Broken({"breaks": breaks, "period": TICK}, Ports())
        entry = ActionEntry("order", "tests:none", "task", "here", "it")
        self.place = InlineHost(
            {"order": entry},
            clock=self.clock,
            driver=self.driver,
            substitutes={"order": getattr(actions, action)},
            virtual=True,
        )
        self.ends: list[Outcome] = []
        self.told: list[Answer] = []
        self._begun = 0

    def run(self, **arguments: Any) -> Outcome:
        """Begin a run, and return its end."""
        self._begun += 1
        identity = f"run{self._begun}"
        self.place.take(self.clock.now, Call(identity, "order", arguments, 5.0))
        for _ in range(2_000):
            self.place.advance(self.clock.now)
            for report in self.place.reports():
                (self.ends if isinstance(report, Outcome) else self.told).append(report)  # type: ignore[arg-type]
            if self.ends and self.ends[-1].id == identity:
                return self.ends[-1]
            self.clock.now += TICK
        raise AssertionError("the run has no end")


@pytest.mark.parametrize(
    "breaks", [name for name in FAULTS if name not in ("surrogate", "huge", "not_plain", "state")]
)
def test_an_exception_of_a_driver_is_the_runs_error(
    breaks: str, caplog: pytest.LogCaptureFixture
) -> None:
    inline = Inline(breaks)
    end = inline.run(send=[{"go": True}, {"break": True}], seconds=3.0)
    assert (end.status, end.cause, end.executed) == ("error", "device_died", "unknown"), end
    assert FAULTS[breaks] in end.text and FAULTS[breaks] in caplog.text
    assert "drivers.py" in caplog.text and "inline_host.py" not in caplog.text, "the user's lines"
    again = inline.run(send=[], seconds=0.1)
    assert (again.cause, again.executed) == ("not_ready", "no") and FAULTS[breaks] in again.text
    inline.place.command(inline.clock.now, Command("c", "status"))
    told = [report for report in inline.place.reports() if isinstance(report, Answer)]
    assert told[0].data["answer"] == "not ready" and FAULTS[breaks] in told[0].data["text"]
    inline.place.close(inline.clock.now)


@pytest.mark.parametrize("verb", ["stop", "hold", "release"])
def test_a_command_of_the_node_that_fails_in_the_driver(verb: str) -> None:
    inline = Inline(verb)
    inline.place.take(
        0.0, Call("r", "order", {"send": [{"go": True}, {"break": True}], "seconds": 3.0}, 5.0)
    )
    inline.place.advance(0.0)
    inline.place.command(0.0, Command("c", verb))
    reports = inline.place.reports()
    assert [
        (r.cause, f"nothing is right in {verb}" in r.text)
        for r in reports
        if isinstance(r, Outcome)
    ] == [("device_died", True)]


@pytest.mark.parametrize("seconds", [0.0, 0.1])
@pytest.mark.parametrize(
    "send", [[{"odd": 1}], [{"odd": 1}, {"go": True}]], ids=["alone", "then another"]
)
def test_a_refused_command_in_lock_step(send: list[dict[str, Any]], seconds: float) -> None:
    inline = Inline("")
    end = inline.run(send=send, seconds=seconds)
    assert (end.status, end.cause) == (
        "error",
        "command_refused",
    ) and "no odd numbers: 1" in end.text
    assert inline.run(send=[{"go": True}], seconds=seconds).status == "success"
    looks = inline.run(send=[{"odd": 1}], seconds=0.1, look=True)
    assert looks.status == "success" and "no odd numbers" in looks.values["refused"]


def test_a_good_run_ends_in_the_tick_in_which_it_returns() -> None:
    """Waiting until its commands are accepted takes no simulated time."""
    inline = Inline("")
    end = inline.run(send=[{"go": True}])
    assert (end.status, end.seconds, inline.clock.now) == ("success", 0.0, 0.0)


HANGING = """\
schema = 1
[nodes.only]
host = "127.0.0.1"
port = {port}
[devices.base]
node = "only"
driver = "toy_cell.drivers:Broken"
period = 0.004
[actions.spin]
run = "toy_cell.actions:spin"
task = "work"
node = "only"
args = {{ how = "{how}" }}
[actions.recover]
run = "toy_cell.actions:nap"
task = "recover"
node = "only"
args = {{ seconds = 0.01 }}
"""
RUN = textwrap.dedent("""\
    import sys
    from petrobot.services.node import watchdog
    watchdog.LIMIT, watchdog.LOOK, watchdog.AGAIN, watchdog.ATTEMPTS = 0.4, 0.05, 0.1, 1
    from petrobot.services.comm.location_file import parse
    from petrobot.services.node.lockstep import LockstepNode
    from petrobot.services.comm.protocol.messages import Call, Hello, Outcome
    from petrobot.services.comm.lockstep.party import Envelope
    from pathlib import Path
    file = Path(sys.argv[1])
    node = LockstepNode(parse(file.read_text(), file), "only")
    hello = Hello(2, 2, "coordinator", "coordinator", "b", 1)
    node.receive(0.0, Envelope("only", "coordinator", "only", "call", hello))
    call = Call("m/p#1", "spin", epoch=1)
    node.receive(0.0, Envelope("only", "coordinator", "spin", "call", call))
    for tick in range(100):
        node.advance(tick * 0.004)
        for envelope in node.drain():
            if isinstance(envelope.body, Outcome):
                print(envelope.body.status, envelope.body.cause, envelope.body.text)
                sys.exit(0)
    print("no end")
""")


def _run_spin(folder: Path, how: str) -> subprocess.CompletedProcess[str]:
    file = folder / "services.toml"
    file.write_text(HANGING.format(port=free_ports(1)[0], how=how))
    return subprocess.run(
        [sys.executable, "-c", RUN, str(file)],
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{OUTSIDE}"},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )


@pytest.mark.processes
@pytest.mark.parametrize("how", ["loop", "program", "stubborn"])
def test_an_action_that_does_not_return_is_named(tmp_path: Path, how: str) -> None:
    """Also one that waits for another program. Its run ends in ERROR, or, if it cannot be
    interrupted, its process ends. The message names node, action, run and line."""
    done = _run_spin(tmp_path, how)
    said = done.stderr
    assert "node only: action spin, run m/p#1, in turn_round (" in said and "actions.py:" in said, (
        done
    )
    assert "runner.py" not in said and "watchdog.py" not in said, "only the user's lines"
    if how == "stubborn":
        assert done.returncode == 3 and "the process ends" in said
    else:
        assert done.stdout.startswith("error hung ") and "turn_round (actions.py:" in done.stdout


def test_a_busy_machine_does_not_trigger_the_watchdog(monkeypatch: pytest.MonkeyPatch) -> None:
    """Time in which a step only waits for the processor is not counted."""
    dog = watchdog.Watchdog("only")
    interrupted: list[int] = []
    monkeypatch.setattr(dog, "_interrupt", interrupted.append)
    monkeypatch.setattr(watchdog, "_sleeps", lambda thread: False)
    used = [0.0]
    monkeypatch.setattr(watchdog, "_processor_time", lambda thread: used[0])
    with dog:
        for _ in range(10_000):  # checks of more than an hour
            dog.look()
        assert not interrupted
        for _ in range(int(watchdog.LIMIT) + 2):
            used[0] += 1.0
            dog.look()
        assert interrupted
    dog.look()
    dog.close()


@pytest.mark.parametrize("by", ["a person", "the action"])
def test_ctrl_c_of_the_user_is_not_confused_with_the_watchdogs(by: str) -> None:
    """In lock step both arrive as KeyboardInterrupt at the same place: the user's ends the command,
    the watchdog's ends only the run."""

    def act(ctx: Any) -> Any:
        if by == "a person":
            signal.raise_signal(signal.SIGINT)
            return None
        raise KeyboardInterrupt

    inline = Inline("")
    inline.place = InlineHost(
        {"order": ActionEntry("order", "tests:none", "task", "here", "")},
        clock=inline.clock,
        substitutes={"order": act},
        virtual=True,
    )
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        if by == "a person":
            with pytest.raises(KeyboardInterrupt):
                inline.run()
        else:
            assert (inline.run().cause, inline.ends[0].text.split()[0]) == (
                "exception",
                "KeyboardInterrupt:",
            )
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.processes
@pytest.mark.parametrize("how", ["exit", "timer", "crash"])
def test_an_action_that_ends_the_process_is_named(tmp_path: Path, how: str) -> None:
    """`os._exit` ends only the run; a crash or a timer ends the process with the line."""
    done = _run_spin(tmp_path, how)
    if how == "exit":
        assert done.stdout.startswith("error exception SystemExit: it called os._exit(0)"), done
    else:
        assert done.returncode < 0 and 'actions.py", line' in done.stderr, done


def test_an_ended_thread_does_not_crash_the_watchdog() -> None:
    """Asking for the processor clock of an ended thread crashes; reading one obtained before does
    not."""
    watched = Watchdog("only")

    def step() -> None:
        with watched:
            pass

    for _ in range(20):
        thread = threading.Thread(target=step)
        thread.start()
        thread.join()
        watched.look()
        assert not watched._attempts
    watched.close()


@pytest.mark.processes
def test_a_driver_that_changes_the_working_folder(tmp_path: Path) -> None:
    """In lock step it runs in the process of the command, whose files must come where they were
    asked for."""
    (elsewhere := tmp_path / "elsewhere").mkdir()

    def petrobot(folder: Path, *words: str) -> None:
        command = [sys.executable, "-m", "petrobot.coordinator", *words]
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE, check=False
        )
        assert done.returncode == 0, done

    petrobot(tmp_path, "new", "robot", "carrier")
    robot = tmp_path / "carrier"
    text, leave = (robot / "carrier.py").read_text(), f"os.chdir({str(elsewhere)!r})"
    methods = {"setup(self)": "setup()", "close(self)": "close()"}
    for method, call in methods.items():
        added = f"    def {method} -> None:\n        {leave}\n        super().{call}\n\n"
        text = text.replace("    def step(", f"{added}    def step(", 1)
    for line in ("        super().step(now)\n", "    await ctx.sleep(0.3)\n"):
        assert line in text
        text = text.replace(line, f"{line[: -len(line.lstrip())]}{leave}\n{line}")
    (robot / "carrier.py").write_text(
        text.replace("\nfrom petrobot", "\nimport os\nfrom petrobot", 1)
    )
    asked = ("--mode", "lockstep", "--journal", "runs", "--json", "out.json")
    petrobot(robot, "run", "carrier.toml", *asked)
    assert (robot / "out.json").exists() and [*(robot / "runs").glob("*/result.json")]
    assert not [*elsewhere.iterdir()]
