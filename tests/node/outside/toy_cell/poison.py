"""Actions and a service that produce values that no message can contain, each in one way."""

from __future__ import annotations

import asyncio
import datetime
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from petrobot.services.action import Context, Result, Status, error, failure, success

from .actions import Leaving


class OwnEnd(BaseException):
    """An exception that `except Exception` does not catch."""


class Mute(Exception):  # noqa: N818 - not a name of ours
    """An exception whose message raises."""

    def __str__(self) -> str:
        raise RuntimeError("no words")


def _unasked(_: object) -> Any:
    raise OwnEnd("bound to nothing")


_SEALED = property(_unasked)
Unbound: Any = type("Unbound", (), {"__class__": _SEALED})
"""A proxy whose object is missing: even its class cannot be asked."""
Classless: Any = type("Classless", (Exception,), {"__class__": _SEALED, "__traceback__": _SEALED})
"""An exception whose class and traceback cannot be asked."""
Ownerless: Any = type("Ownerless", (AttributeError,), {"obj": _SEALED})
"""One that does not tell which object lacks the attribute."""


class Endless(Mapping[str, Any]):
    """A mapping without an end."""

    def __getitem__(self, key: str) -> Any:
        return 1

    def __len__(self) -> int:
        raise OverflowError("there is no end")

    def __iter__(self) -> Iterator[str]:
        number = 0
        while True:
            number += 1
            yield str(number)


class Unreadable(Mapping[str, Any]):
    """A mapping that cannot be read."""

    def __getitem__(self, key: str) -> Any:
        raise OwnEnd("not for you")

    def __len__(self) -> int:
        return 1

    def __iter__(self) -> Iterator[str]:
        raise ArithmeticError("cannot be counted")


def _bomb() -> list[Any]:
    layers: list[Any] = [0]
    for _ in range(25):
        layers = [layers] * 20
    return layers


def _cycle() -> dict[str, Any]:
    one: dict[str, Any] = {}
    one["again"] = [one, one]
    return one


def _deep(depth: int) -> Any:
    return [_deep(depth - 1)] if depth else 0


def _raise(fault: BaseException) -> Result:
    raise fault


RESULTS: Mapping[str, Callable[[], Any]] = {
    "long cause": lambda: error("x" * 1234),
    "long cause of a success": lambda: Result(Status.SUCCESS, {}, "x" * 256),
    "an exception as cause": lambda: error(str(ValueError("y" * 300))),
    "half a letter as cause": lambda: error("\ud800"),
    "half a letter as text": lambda: failure("x", "a\udfffb"),
    "half a letter as value": lambda: success(x=["a", "\ud800"]),
    "half a letter as key": lambda: success(x={"\ud800": 1}),
    "a text too large": lambda: error("x", "y" * (17 << 20)),
    "many containers": lambda: success(x=[[] for _ in range(100_001)]),
    "many containers, flat": lambda: success(x=[{} for _ in range(99_999)], y=[[]]),
    "65 MiB": lambda: success(x=bytes(65 << 20)),
    "17 MiB of text": lambda: success(x="y" * (17 << 20)),
    "17 MiB of numbers": lambda: success(x=[1] * (17 << 20)),
    "a bomb": lambda: success(x=_bomb()),
    "a cycle": lambda: success(x=_cycle()),
    "too deep": lambda: success(x=_deep(33)),
    "a large integer": lambda: success(x=2**64),
    "a small integer": lambda: success(x=-(2**63) - 1),
    "a very large integer": lambda: success(x=10**6000),
    "an array": lambda: success(x=np.zeros(3)),
    "an array of none": lambda: success(x=np.array(1.0)),
    "a numpy date": lambda: success(x=np.datetime64("2024-01-01", "ns")),
    "a long double": lambda: success(x=np.longdouble(1.0)),
    "a complex number": lambda: success(x=1j),
    "a set": lambda: success(x={1, 2}),
    "a date": lambda: success(x=datetime.datetime.now(tz=datetime.UTC)),
    "a bool as key": lambda: success(x={True: 1}),
    "a number as key": lambda: success(x={1: 2}),
    "a large number as key": lambda: success(x={10**6000: 2}),
    "a numpy text as key": lambda: success(x={np.str_("a"): 2}),
    "an endless mapping": lambda: success(x=Endless()),
    "an unreadable mapping": lambda: success(x=Unreadable()),
    "a bytearray": lambda: success(x=bytearray(b"a")),
    "an iterator": lambda: success(x=iter([1])),
    "no values": lambda: Result(Status.SUCCESS, None),  # type: ignore[arg-type]
    "values in a list": lambda: Result(Status.SUCCESS, [1]),  # type: ignore[arg-type]
    "an unknown status": lambda: Result("perhaps", {}),  # type: ignore[arg-type]
    "no status": lambda: Result(None, {}),  # type: ignore[arg-type]
    "no result": lambda: None,
    "a proxy without its object": Unbound,
    "a value that is such a proxy": lambda: success(x=Unbound()),
    "a dict": lambda: {"x": 1},
    "a cause without words": lambda: error(Mute()),  # type: ignore[arg-type]
    "a cause that leaves": lambda: error(Leaving()),  # type: ignore[arg-type]
    "a value that leaves": lambda: Result(
        Status.SUCCESS,
        {},
        deferred=Leaving(),  # type: ignore[arg-type]
    ),
}
"""Values that an action returns; each must end its run as `bad_result`."""
RAISES: Mapping[str, Callable[[], BaseException]] = {
    "KeyboardInterrupt": KeyboardInterrupt,
    "SystemExit": lambda: SystemExit(3),
    "GeneratorExit": GeneratorExit,
    "an exception of its own": lambda: OwnEnd("mine"),
    "a cancellation": asyncio.CancelledError,
    "StopIteration": lambda: StopIteration(3),
    "one without words": Mute,
    "one whose words leave": Leaving,
    "one without a class": Classless,
    "one without an object": Ownerless,
    "one with many words": lambda: ValueError("x" * 20_000_000),
    "one with half a letter": lambda: ValueError("\ud800"),
}
"""Exceptions that it raises; each must end its run as `exception`."""
SAYS: Mapping[str, Callable[[Context], Any]] = {
    "an event with a long name": lambda ctx: ctx.raise_event("e" * 256),
    "an event with half a letter": lambda ctx: ctx.raise_event("\ud800"),
    "an event without a name": lambda ctx: ctx.raise_event(None),  # type: ignore[arg-type]
    "an event with much data": lambda ctx: ctx.raise_event("e", x=bytes(3 << 20)),
    "an event with a set": lambda ctx: ctx.raise_event("e", x={1}),
    "much progress": lambda ctx: ctx.progress(0.5, x=bytes(70_000)),
    "progress that is no number": lambda ctx: ctx.progress(float("nan")),
    "progress in words": lambda ctx: ctx.progress("half"),  # type: ignore[arg-type]
    "a long set point": lambda ctx: ctx.publish("points", [0.0] * 100_000),
    "a set point that is no number": lambda ctx: ctx.publish("points", [float("inf")]),
    "a verdict with a long cause": lambda ctx: ctx.verdict("m/p#1", failure("x" * 300)),
    "a verdict with half a letter": lambda ctx: ctx.verdict("m/p#1", failure("x", "\ud800")),
    "a verdict on much": lambda ctx: ctx.verdict("m" * 250 + "/p#1", failure("x")),
}
"""Events and progress that it sends; each must end its run as `exception`."""
ASKS: Mapping[str, Callable[[Context], Any]] = {
    "a service with a long name": lambda ctx: ctx.call("s" * 256),
    "a service with half a letter": lambda ctx: ctx.call("\ud800"),
    "a deadline below zero": lambda ctx: ctx.call("sum_service", -1.0, a=1),
    "a deadline that is no number": lambda ctx: ctx.call("sum_service", float("nan"), a=1),
    "a deadline in words": lambda ctx: ctx.call("sum_service", "soon", a=1),  # type: ignore[arg-type]
    "a large argument": lambda ctx: ctx.call("sum_service", a=bytes(17 << 20)),
    "a set as argument": lambda ctx: ctx.call("sum_service", a={1}),
    "many containers as argument": lambda ctx: ctx.call("sum_service", a=[[]] * 100_001),
    "a large value in the memory": lambda ctx: ctx.put("v", bytes(2 << 20)),
    "a bomb in the memory": lambda ctx: ctx.put("v", _bomb()),
    "a long name in the memory": lambda ctx: ctx.put("v" * 300, 1),
}
"""Calls that it makes; each must end its run as `exception`."""


def _made(kind: str) -> Any:
    return _raise(RAISES[kind]()) if kind in RAISES else RESULTS[kind]()


async def give(ctx: Context, *, kind: str) -> Result:
    """Return, raise, send or call the value of this name."""
    await ctx.sleep(0.01)
    if kind in SAYS:
        SAYS[kind](ctx)
        await ctx.sleep(0.05)
        return success()
    if kind in ASKS:
        await ASKS[kind](ctx)
        return success()
    made: Result = _made(kind)
    return made


def serve(ctx: Context, *, kind: str) -> Result:
    """Do the same as a service."""
    if kind in SAYS:
        SAYS[kind](ctx)
        return success()
    made: Result = _made(kind)
    return made


def echo(ctx: Context, *, value: Any) -> Result:
    """Return the argument."""
    return success(value=value)
