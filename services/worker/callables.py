"""User code as Python callables: check arguments against signatures, and describe exceptions in one
line."""

from __future__ import annotations

import contextlib
import dis
import inspect
import logging
import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from itertools import islice, takewhile
from pathlib import Path
from types import FrameType
from typing import Any

_SERVICES = Path(__file__).parents[1]
_OURS = tuple(
    f"{_SERVICES}/{each}" for each in ("worker/", "node/", "comm/", "device.py", "conformance.py")
)
_LIBRARY = f"{Path(os.__file__).parent}/"
"""Files whose frames are left out of the traceback that users see."""
LONGEST = 2_000
"""Longest description (characters): an exception may quote all of the data that it is about."""
FRAMES, CHAIN = 50, 8
"""Most frames of one traceback in the log, and most exceptions in a chain of causes."""
RAISED = (Exception, SystemExit, GeneratorExit)
"""What code of a driver may raise: a library of its vendor may call `sys.exit`. (KeyboardInterrupt
may be a Ctrl-C.)"""
_RAISE = dis.opmap["RAISE_VARARGS"]


@lru_cache(maxsize=4096)
def _parameters(function: Callable[..., Any]) -> tuple[tuple[str, ...], tuple[str, ...], bool]:
    """Return the names of a callable's parameters after the context, those without a default, and
    whether it accepts any name."""
    parameters = list(inspect.signature(function).parameters.values())[1:]
    named = [p for p in parameters if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)]
    needed = tuple(p.name for p in named if p.default is p.empty)
    return (
        tuple(sorted(p.name for p in named)),
        needed,
        any(p.kind is p.VAR_KEYWORD for p in parameters),
    )


def check_arguments(function: Callable[..., Any], arguments: Mapping[str, Any]) -> None:
    """Raise a TypeError that names the argument which does not fit and what would fit. The first
    parameter is the context."""
    names, needed, takes_any = _parameters(function)
    for name in arguments:
        if name not in names and not takes_any:
            raise TypeError(f"takes no argument {name!r}; it takes: {', '.join(names) or 'none'}")
    for name in needed:
        if name not in arguments:
            raise TypeError(
                f"needs the argument {name!r}; give it as args in services.toml or in the task"
            )


def words_of(fault: BaseException) -> str:
    """Return the message of an exception as text that can always be sent: cut at `LONGEST`
    characters, with anything that is not Unicode escaped."""
    try:
        said = str(fault)
    except BaseException as worse:  # its words are code of a user, too
        if from_outside(worse):
            raise
        said = f"(its message cannot be had: {type(worse).__name__})"
    if len(said) > LONGEST:
        said = f"{said[:LONGEST]}... ({len(said):,} characters)"
    return said.encode("utf-8", "backslashreplace").decode()


def describe(fault: BaseException) -> str:
    """Return the type and message of an exception, and the last three lines of user code that it
    came through."""
    try:
        steps = [step for step in traceback.walk_tb(fault.__traceback__) if is_users(step[0])]
        return f"{type(fault).__name__}: {words_of(fault)}{_places(steps[:-4:-1])}"
    except BaseException as worse:  # its attributes are code of a user, too
        if from_outside(worse):
            raise
        return "an exception that cannot be described"


def where(frame: FrameType) -> str:
    """Return up to three lines of user code that led to a frame, as `describe` does."""
    steps = takewhile(lambda step: is_users(step[0]), traceback.walk_stack(frame))
    return _places(islice(steps, 3))


def is_users(frame: FrameType) -> bool:
    """Return whether a frame is of an action or a driver: neither of petrobot's machinery nor of
    Python's own library."""
    name = frame.f_code.co_filename
    library = name.startswith(("<frozen ", _LIBRARY)) and "-packages/" not in name
    return not (library or name.startswith(_OURS))


def _places(steps: Iterable[tuple[FrameType, int]]) -> str:
    """Return lines of code as text, the innermost first; empty if there are none."""
    places = " < ".join(
        f"{frame.f_code.co_name} ({Path(frame.f_code.co_filename).name}:{line})"
        for frame, line in steps
    )
    return f" in {places}" if places else ""


def log_fault(log: logging.Logger, fault: BaseException, text: str, *arguments: Any) -> None:
    """Log an error of user code with its traceback. This raises nothing, although the user code may
    have used up the memory or made its exceptions unreadable."""
    try:
        trace = _traceback(fault)
    except BaseException as worse:
        if from_outside(worse):
            raise
        trace = f"(its traceback cannot be had: {type(worse).__name__})"
    with contextlib.suppress(Exception):  # a handler of the user may raise
        log.error(f"{text}\n%s", *arguments, trace)


def _traceback(fault: BaseException) -> str:
    """Return the traceback of an exception after those of the exceptions that led to it.

    As Python prints them, but only the lines of user code if there are any, and its message as
    `words_of` has it. An exception of petrobot's own says what is wrong: without lines of user code
    it needs none.
    """
    parts: list[str] = []
    found: BaseException | None = fault
    while found is not None and len(parts) < CHAIN:
        every = list(traceback.walk_tb(found.__traceback__))
        shown = [step for step in every if is_users(step[0])]
        if not shown and not type(found).__module__.startswith("petrobot."):
            shown = every
        lines = traceback.StackSummary.extract(iter(shown[-FRAMES:])).format()
        parts.append(f"{''.join(lines)}{type(found).__name__}: {words_of(found)}")
        hidden = found.__suppress_context__
        found = found.__cause__ if found.__cause__ is not None or hidden else found.__context__
    return "\n-- then --\n".join(reversed(parts))


def from_outside(fault: BaseException) -> bool:
    """Return whether the exception is a Ctrl-C at a terminal and was not raised by the code that it
    interrupted.

    Python raises KeyboardInterrupt for it wherever the main thread is; code that raises one itself
    does it by a `raise`.
    """
    if (
        not issubclass(type(fault), KeyboardInterrupt)  # not `isinstance`: that asks the exception
        or threading.current_thread() is not threading.main_thread()
    ):
        return False
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return False  # a worker ignores the signal, a node takes it in its loop
    place = fault.__traceback__
    while place is not None and place.tb_next is not None:
        place = place.tb_next
    return place is None or place.tb_frame.f_code.co_code[place.tb_lasti] != _RAISE
