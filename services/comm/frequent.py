"""The kinds that make up nearly all traffic, written and read without the codec's table: the same
bytes, a third of the time.

A reader gives None for fields that are not of the usual types, ranges and number: the table then
says what is wrong with them, or takes what it may (trailing fields left out, an integer for a
float). So nothing is accepted here that the table refuses; tests/comm/test_codec.py holds that.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import inf
from typing import Any, Final

from petrobot.services.comm.messages import Call, Executed, Message, Outcome
from petrobot.services.comm.plain import inspect

NAME_LENGTH: Final = 255
"""Longest name, id or code (characters)."""
COUNT_END: Final = 2**63
"""Counts are below it."""
EXECUTED: Final = {str(one): one for one in Executed}


Reader = Callable[[list[Any], bool], Message | None]


def _call(fields: list[Any], short: bool) -> Message | None:
    if len(fields) != 9:
        return None
    _, id_, service, arguments, deadline, epoch, boot, parent, seed = fields
    if (
        type(id_) is type(service) is type(boot) is type(parent) is str
        and (short or max(len(id_), len(service), len(boot), len(parent)) <= NAME_LENGTH)
        and type(arguments) is dict
        and (deadline is None or (type(deadline) is float and 0.0 <= deadline < inf))
        and type(epoch) is type(seed) is int
        and 0 <= epoch < COUNT_END
        and 0 <= seed < COUNT_END
    ):
        inspect(arguments)
        return Call(id_, service, arguments, deadline, epoch, boot, parent, seed)
    return None


def _outcome(fields: list[Any], short: bool) -> Message | None:
    if len(fields) != 9:
        return None
    _, id_, status, values, cause, text, executed, seconds, cpu_seconds = fields
    if (
        type(id_) is type(status) is type(cause) is type(text) is type(executed) is str
        and (short or max(len(id_), len(status), len(cause)) <= NAME_LENGTH)
        and type(values) is dict
        and executed in EXECUTED
        and type(seconds) is type(cpu_seconds) is float
        and 0.0 <= seconds < inf
        and 0.0 <= cpu_seconds < inf
    ):
        inspect(values)
        return Outcome(id_, status, values, cause, text, EXECUTED[executed], seconds, cpu_seconds)
    return None


READERS: Mapping[int, Reader] = {Call.KIND: _call, Outcome.KIND: _outcome}
"""By kind: reads the array of a body; `short` says that it is shorter than the longest name. Raises
NotPlainError."""


def _call_row(call: Any) -> tuple[Any, ...] | None:
    id_, service, deadline, epoch = call.id, call.service, call.deadline, call.epoch
    boot, parent, seed = call.boot, call.parent, call.seed
    if (
        type(id_) is type(service) is type(boot) is type(parent) is str
        and len(id_) <= NAME_LENGTH
        and len(service) <= NAME_LENGTH
        and len(boot) <= NAME_LENGTH
        and len(parent) <= NAME_LENGTH
        and (deadline is None or (type(deadline) is float and 0.0 <= deadline < inf))
        and type(epoch) is type(seed) is int
        and 0 <= epoch < COUNT_END
        and 0 <= seed < COUNT_END
    ):
        row = (4, id_, service, call.arguments, deadline, epoch, boot, parent, seed)
        return (
            (*row, True) if call.again else row
        )  # seldom: after a broken link or a restart of the caller
    return None


def _outcome_row(end: Any) -> tuple[Any, ...] | None:
    id_, status, cause, text, seconds, cpu = (
        end.id,
        end.status,
        end.cause,
        end.text,
        end.seconds,
        end.cpu_seconds,
    )
    if (
        type(id_) is type(cause) is type(text) is str
        and isinstance(status, str)
        and len(id_) <= NAME_LENGTH
        and len(status) <= NAME_LENGTH
        and len(cause) <= NAME_LENGTH
        and (type(end.executed) is Executed or end.executed in EXECUTED)
        and type(seconds) is type(cpu) is float
        and 0.0 <= seconds < inf
        and 0.0 <= cpu < inf
    ):
        row = (7, id_, status, end.values, cause, text, end.executed, seconds, cpu)
        return (*row, True) if end.deferred else row  # seldom
    return None


WRITERS: Mapping[int, Callable[[Any], tuple[Any, ...] | None]] = {
    Call.KIND: _call_row,
    Outcome.KIND: _outcome_row,
}
"""By kind: the message as the array that is its body; None for one that the table has to look
at."""
