"""Actions and services of the toy cell: good ones, slow ones, and ones that hang, crash or use up
memory."""

from __future__ import annotations

import builtins
import ctypes
import decimal
import gc
import logging
import multiprocessing
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from petrobot.services.action import Cancelled, Context, Result, Status, error, failure, success

from .drivers import never_return


def add(ctx: Context, *, a: int, b: int = 1) -> Result:
    """Return the sum."""
    return success(sum=a + b)


CHANGES: dict[str, Callable[[], Any]] = {
    "": lambda: None,
    "folder": lambda: os.chdir("/"),
    "mask": lambda: os.umask(0o777),
    "depth": lambda: sys.setrecursionlimit(60),
    "timer": lambda: signal.setitimer(signal.ITIMER_REAL, 0.2),
    "memory": lambda: resource.setrlimit(resource.RLIMIT_AS, (1 << 20, resource.RLIM_INFINITY)),
    "clock": lambda: vars(time).update(monotonic=str, time=str, process_time=str),
    "no output": lambda: setattr(sys, "stdout", None),
    "closed output": lambda: sys.stdout.close(),
    "closed files": lambda: os.closerange(0, 3),
    "environment": lambda: os.environ.update(PATH="/nowhere"),
    "path": lambda: sys.path.clear(),
    "children": lambda: signal.signal(signal.SIGCHLD, signal.SIG_IGN),
    "warnings": lambda: warnings.simplefilter("error"),
    "sockets": lambda: socket.setdefaulttimeout(1e-6),
    "numbers": lambda: np.seterr(all="raise"),
    "hook": lambda: setattr(sys, "excepthook", None),
    "precision": lambda: setattr(decimal.getcontext(), "prec", 2),
    "temporary files": lambda: setattr(tempfile, "tempdir", "/nowhere"),
    "built-in": lambda: setattr(builtins, "open", None),
    "collector": gc.disable,
    "silence": lambda: logging.disable(logging.CRITICAL),
    "processor": lambda: os.sched_setaffinity(0, list(os.sched_getaffinity(0))[:1]),
    "signals": lambda: signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM]),
    "priority": lambda: os.nice(1),
    "files": lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (5, 1024)),
}
"""What an action may leave behind in its process."""


def change(ctx: Context, *, what: str = "") -> Result:
    """Return how the process is, and change it."""
    mask = os.umask(0o022)
    os.umask(mask)
    depth = sys.getrecursionlimit()
    found = [str(Path.cwd()), mask, depth, list(resource.getrlimit(resource.RLIMIT_NOFILE))]
    found.append(sys.stdout is not None and not sys.stdout.closed)
    found += [os.environ["PATH"], bool(sys.path), str(signal.getsignal(signal.SIGCHLD))]
    found += [[each[0] for each in warnings.filters], socket.getdefaulttimeout(), np.geterr()]
    found.append([Path(f"/proc/self/fd/{number}").exists() for number in range(3)])
    found += [sys.excepthook is sys.__excepthook__, decimal.getcontext().prec]
    found += [tempfile.gettempdir(), open is not None, gc.isenabled()]
    found += [logging.root.manager.disable, sorted(os.sched_getaffinity(0)), os.nice(0)]
    found.append(len(signal.pthread_sigmask(signal.SIG_BLOCK, ())))
    CHANGES[what]()
    return success(found=found, pid=os.getpid())


def write_down(ctx: Context, *, file: str, line: str) -> Result:
    """Append a line to a file, in one write."""
    with Path(file).open("ab", buffering=0) as out:
        out.write(f"{line}\n".encode())
    return success()


async def chatter(ctx: Context, *, what: str) -> Result:
    """Report progress or raise events, as fast as it can, without end."""
    while True:
        for number in range(20_000):
            if what == "progress":
                ctx.progress(0.5, number=number)
            else:
                ctx.raise_event("chatter", number=number)
        await ctx.sleep(1e-9)


async def nap(ctx: Context, *, seconds: float, gate: str = "") -> Result:
    """Send progress, then wait; with a `gate`, until this file is removed, if that is earlier."""
    ctx.progress(0.0)
    if gate:
        await ctx.wait(lambda: not Path(gate).exists(), seconds)
    else:
        await ctx.sleep(seconds)
    return success(slept=seconds)


async def go(ctx: Context, *, to: float, timeout: float = 5.0) -> Result:
    """Send progress, send the slide to a position, and wait until it is there."""
    ctx.progress(0.0)
    number = ctx.device.send({"to": to})
    await ctx.wait(lambda: ctx.device.handled >= number, 60.0)
    if ctx.device.refused:
        return error("refused", ctx.device.refused)
    try:
        there = await ctx.wait(lambda: abs(ctx.device.state["position"] - to) < 1e-6, timeout)
    except Cancelled:
        ctx.device.send({"halt": True})
        raise
    return success(position=ctx.device.state["position"]) if there else failure("slow")


async def loop(ctx: Context, *, after: float) -> Result:
    """Move the slide, and let its driver hang after so many seconds."""
    ctx.device.send({"to": 90.0})
    await ctx.sleep(after)
    ctx.device.send({"loop": True})
    await ctx.sleep(60.0)
    return success()


async def follow(ctx: Context, *, seconds: float) -> Result:
    """Let the slide follow the stream for a while."""
    ctx.device.send({"follow": True})
    await ctx.sleep(seconds)
    ctx.device.send({"halt": True})
    return success(position=ctx.device.state["position"], count=ctx.device.state["count"])


async def lead(ctx: Context, *, seconds: float, speed: float = 0.5) -> Result:
    """Publish set points along a line, one every 8 ms."""
    begun = ctx.now
    while ctx.now < begun + seconds:
        ctx.publish("points", [speed * (ctx.now - begun)])
        await ctx.sleep(0.008)
    ctx.raise_event("led", seconds=seconds)
    return success()


async def look(ctx: Context, *, images: int) -> Result:
    """Take so many images; return their sequence numbers, ages and sums."""
    source = ctx.device.images
    source.start(50.0)
    seen: list[list[float]] = []
    while len(seen) < images:
        taken: list[object] = []

        def ready() -> bool:
            image = source.newest()
            if image is not None:
                seen.append([image.sequence, ctx.now - image.time, int(image.pixels.sum())])
            return image is not None

        if not await ctx.wait(ready, 1.0):
            return error("no_image")
        taken.clear()
    source.stop()
    return success(seen=seen)


async def relay(ctx: Context, *, a: int) -> Result:
    """Call an action of another node, and the global memory, by name."""
    result = await ctx.call("sum_service", a=a, b=2)
    version = await ctx.put("sum", result.values.get("sum"))
    return success(sum=await ctx.get("sum"), version=version, pid=os.getpid())


async def delegate(ctx: Context, *, service: str) -> Result:
    """Return what a service answered."""
    result = await ctx.call(service, 1.0)
    return success(status=str(result.status), cause=result.cause, text=result.text)


async def swap(ctx: Context, *, times: int) -> Result:
    """Increment a shared variable so many times, while other actions do the same."""
    for _ in range(times):
        while True:
            seen = await ctx.call("memory.get", name="count")
            value, version = seen.values["value"] or 0, seen.values["version"]
            if await ctx.compare_and_set("count", version, value + 1):
                break
    return success()


def secret(ctx: Context) -> Result:
    """A service for callers of the same host."""
    return success(secret=42)


async def slow_service(ctx: Context, *, seconds: float) -> Result:
    """A service that waits."""
    await ctx.sleep(seconds)
    return success()


def hang(ctx: Context) -> Result:
    """Never return, in a C call that Python cannot interrupt."""
    never_return()


async def hang_moving(ctx: Context) -> Result:
    """Send the slide far away, then hang."""
    ctx.device.send({"to": 90.0})
    await ctx.sleep(0.1)
    never_return()


def segfault(ctx: Context) -> Result:
    """Read an invalid address."""
    ctypes.string_at(8)
    return success()


def leave(ctx: Context, *, code: int = 7) -> Result:
    """End the whole process."""
    os._exit(code)


def eat(ctx: Context, *, megabytes: int) -> Result:
    """Allocate much memory."""
    block = bytearray(megabytes << 20)
    return success(bytes=len(block))


def keep_memory(ctx: Context) -> Result:
    """Allocate more and more memory, and keep it."""
    while True:
        kept.append(bytearray(1 << 16))


kept: list[bytearray] = []


def pid(ctx: Context) -> Result:
    """Return the id of the process that runs this."""
    return success(pid=os.getpid())


async def tell(ctx: Context, *, name: str) -> Result:
    """Raise an event, report progress, wait a little."""
    ctx.raise_event(name, run=ctx.run)
    ctx.progress(0.5, note="half")
    await ctx.sleep(0.1)
    return success(draw=float(ctx.random("x").random()))


def twisted(ctx: Context) -> Result:
    """Return what no message can contain."""
    return success(rows=[{"key": {1: 2}}])


def unsure(ctx: Context) -> Result:
    """Lost its link on the way."""
    return replace(error("lost", "no answer"), executed="unknown")


def double(ctx: Context, *, numbers: tuple[float, ...]) -> Result:
    """Return a tuple, and send one in an event."""
    ctx.raise_event("doubled", count=len(numbers))
    return success(numbers=tuple(2.0 * n for n in numbers))


class Leaving(Exception):  # noqa: N818 - not a name of ours
    """An exception, and a value, that raise SystemExit when they are read."""

    def __str__(self) -> str:
        raise SystemExit(3)

    def __bool__(self) -> bool:
        raise SystemExit(3)


def leaving(ctx: Context, *, by: str) -> Result:
    """Raise or return what cannot be read."""
    if by == "exception":
        raise Leaving
    return Result(Status.SUCCESS, {}, deferred=Leaving())  # type: ignore[arg-type]


def broken(ctx: Context) -> Result:
    """Raise an exception."""
    raise ZeroDivisionError("nothing is divided by nothing")


def judge(ctx: Context, *, run: str) -> Result:
    """Send a verdict on an earlier run."""
    ctx.verdict(run, failure("crooked"))
    return success()


def slow_disk(ctx: Context, *, seconds: float) -> Result:
    """Let each sync of its node take this long from now on."""

    def fsync(file: int) -> None:
        time.sleep(seconds)
        os.fdatasync(file)

    os.fsync = fsync  # type: ignore[assignment]
    return success()


def block(ctx: Context, *, seconds: float, mark: str = "", gate: str = "") -> Result:
    """Block the interpreter's only thread, as a driver's library may. With a `gate`, make the file
    `mark`, and block until the file `gate` is removed, if that is earlier."""
    if gate:
        Path(mark).touch()
        end = time.monotonic() + seconds
        while Path(gate).exists() and time.monotonic() < end:
            time.sleep(0.005)
    else:
        time.sleep(seconds)
    return success(slept=seconds)


def freeze_at_once(ctx: Context) -> Result:
    """Block for longer than a test waits."""
    time.sleep(60.0)
    return success()


async def freeze(ctx: Context) -> Result:
    """The same, as a service that may wait."""
    return freeze_at_once(ctx)


def leave_behind(ctx: Context, *, how: str, mark: str, then: str = "return") -> Result:
    """Start a process that survives this action, in one of several ways; its process id is written
    to `mark`. Then return, block, crash or exit."""
    LEAVERS[how](mark)
    while not (Path(mark).exists() and Path(mark).read_text()):
        time.sleep(0.005)
    if then == "block":
        time.sleep(3600.0)
    elif then == "crash":
        ctypes.string_at(8)
    return success(pid=os.getpid())


def _live_on(mark: str) -> None:
    Path(mark).write_text(str(os.getpid()))
    time.sleep(3600.0)


def _fork(mark: str) -> None:
    multiprocessing.get_context("fork").Process(target=_live_on, args=(mark,), daemon=True).start()


def _daemon(mark: str) -> None:
    """Fork twice into a new session: the process has no parent any more, and nothing shows where it
    comes from."""
    if os.fork() == 0:
        os.setsid()
        os.environ.clear()
        if os.fork() == 0:
            _live_on(mark)
        os._exit(0)
    os.wait()


def _program(mark: str) -> None:
    left.append(subprocess.Popen(["sleep", "3600"]))
    Path(mark).write_text(str(left[-1].pid))


def _program_with_sockets(mark: str) -> None:
    """Start a program that inherits every file descriptor of this process."""
    open_ones = [int(one.name) for one in Path("/proc/self/fd").iterdir() if int(one.name) > 2]
    passed = [one for one in open_ones if Path(f"/proc/self/fd/{one}").exists()]
    left.append(subprocess.Popen(["sleep", "3600"], pass_fds=passed, start_new_session=True))
    Path(mark).write_text(str(left[-1].pid))


def _no_pipe(mark: str) -> None:
    """Close every file descriptor, also the pipe to the node."""
    os.closerange(3, 1000)
    Path(mark).write_text(str(os.getpid()))


def _fork_that_returns(mark: str) -> None:
    """Fork a copy of the worker that returns from the action as if it were the worker."""
    if os.fork() == 0:
        return
    Path(mark).write_text(str(os.getpid()))


LEAVERS = {
    "fork": _fork,
    "daemon": _daemon,
    "program": _program,
    "program with sockets": _program_with_sockets,
    "no pipe": _no_pipe,
    "fork that returns": _fork_that_returns,
}
left: list[subprocess.Popen[bytes]] = []


async def order(
    ctx: Context,
    *,
    send: list[dict[str, Any]],
    seconds: float = 0.0,
    look: bool = False,
    ends: str = "success",
    report: bool = False,
) -> Result:
    """Send commands, wait a little, and end as requested, even if the driver failed on the
    commands. With `report`, send progress when the driver has handled them."""
    number = 0
    for body in send:
        number = ctx.device.send(body)
    if report:
        await ctx.wait(lambda: ctx.device.handled >= number)
        ctx.progress(0.5)
    if seconds:
        await ctx.sleep(seconds)
    if look:
        return success(refused=ctx.device.refused)
    if ends == "raise":
        raise ValueError("the action's own words")
    return success() if ends == "success" else error("own", "the action's own words")


async def order_directly(ctx: Context, *, send: list[dict[str, Any]], seconds: float) -> Result:
    """As `order`, with a driver in the same process; always sends progress."""
    for body in send:
        ctx.device.command(ctx.now, body)
    ctx.progress(0.5)
    await ctx.sleep(seconds)
    return success()


async def spin(ctx: Context, *, how: str = "loop") -> Result:
    """Loop without end or wait for another `program`; if `stubborn`, ignore every interruption."""
    await ctx.sleep(0.02)
    while True:
        try:
            turn_round(how)
        except BaseException:
            if how != "stubborn":
                raise


def turn_round(how: str) -> None:
    """Loop without end, or wait for a program that does not end in time."""
    if how == "program":
        subprocess.run(["sleep", "60"], check=True)
    if how == "exit":
        os._exit(0)
    if how == "timer":
        signal.setitimer(signal.ITIMER_REAL, 0.01)
    if how == "crash":
        os.abort()
    while True:
        pass
