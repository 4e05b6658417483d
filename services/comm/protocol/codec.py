"""Encode messages as bytes and decode them: each message is a msgpack array `[kind, field, ...]`.

Every field is checked in both directions by the same rules, so a message that this side can encode
is never refused by the other side.

There are two code paths. `_Spec` describes every kind as a table built from its annotations. CALL,
RESULT and SET POINT, which make up nearly all traffic, also have hand-written readers and writers
(`READERS`, `WRITERS`) that produce the same bytes in a third of the time. A fast path only handles
what is valid and ordinary; whatever it does not accept goes to the table, which finds the fault and
words the error. So each rule is worded in one place, and tests compare the two paths.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from math import inf, isfinite
from operator import attrgetter
from types import ModuleType
from typing import Any, Final, NamedTuple, get_args

import msgpack

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.lockstep.party import Envelope, Posted
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.messages import (
    Call,
    Executed,
    Message,
    Outcome,
    SetPoint,
    Tick,
)
from petrobot.services.comm.protocol.plain import (
    LARGEST,
    MAX_CONTAINERS as MAX_CONTAINERS,
    MOST_VALUES,
    SCALARS,
    NotPlainError,
    inspect,
    is_numpy,
    pack_array,
    unpack_array,
)

NAME_LENGTH: Final = 255
"""Longest name, id or code (characters)."""
COUNT_END: Final = 2**63
"""Counts are below this number, so that they fit a signed 64-bit integer in any language."""
EXECUTED: Final = {str(one): one for one in Executed}
"""The enum member by its text on the wire."""


Reader = Callable[[list[Any], bool], Message | None]


# Comparing `type(x) is str` for all fields in one chain is the fastest check that CPython offers;
# isinstance would also accept subclasses, which msgpack never produces.
def _call(fields: list[Any], short: bool) -> Message | None:
    """Read a CALL of exactly nine fields. One with `again` has ten and goes to the table."""
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
    """Read a RESULT of exactly nine fields. One with `deferred` has ten and goes to the table."""
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


_FLOAT = frozenset((float,))


def _set_point(fields: list[Any], short: bool) -> Message | None:
    """Read a set point whose numbers are all floats."""
    if len(fields) != 5:
        return None
    _, number, values, held, elapsed = fields
    if (
        type(number) is int
        and 0 <= number < COUNT_END
        and type(values) is list
        and _FLOAT.issuperset(map(type, values))
        and all(map(isfinite, values))
        and type(held) is type(elapsed) is float
        and 0.0 <= held < inf
        and 0.0 <= elapsed < inf
    ):
        return SetPoint(number, tuple(values), held, elapsed)
    return None


READERS: Mapping[int, Reader] = {
    Call.KIND: _call,
    Outcome.KIND: _outcome,
    SetPoint.KIND: _set_point,
}
"""Fast reader by kind: turns the array of a body into a message, or returns None if the table must
look at it.

`short` says that the whole body is shorter than the longest name; then no name in it needs to be
measured. Raises NotPlainError.
"""


def _call_row(call: Any) -> tuple[Any, ...] | None:
    """Return a CALL as the array that is its body; None if the table must look at it."""
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
        # `again` is true only after a broken link or a restart of the caller.
        return (*row, True) if call.again else row
    return None


def _outcome_row(end: Any) -> tuple[Any, ...] | None:
    """Return a RESULT as the array that is its body; None if the table must look at it."""
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
        return (*row, True) if end.deferred else row
    return None


def _set_point_row(point: Any) -> tuple[Any, ...] | None:
    """Return a set point as the array that is its body; None if the table must look at it."""
    number, values, held, elapsed = point.number, point.values, point.held, point.elapsed
    if (
        type(number) is int
        and 0 <= number < COUNT_END
        and type(values) is tuple
        and _FLOAT.issuperset(map(type, values))
        and all(map(isfinite, values))
        and type(held) is type(elapsed) is float
        and 0.0 <= held < inf
        and 0.0 <= elapsed < inf
    ):
        return (22, number, values, held, elapsed)
    return None


WRITERS: Mapping[int, Callable[[Any], tuple[Any, ...] | None]] = {
    Call.KIND: _call_row,
    Outcome.KIND: _outcome_row,
    SetPoint.KIND: _set_point_row,
}
"""Fast writer by kind: returns the array that is the body, or None if the table must look at the
message."""


KIB, MIB = 1024, 1024 * 1024

LIMITS: Mapping[int, int] = {
    m.Hello.KIND: 4 * KIB,
    m.Welcome.KIND: MIB,
    m.Refuse.KIND: 4 * KIB,
    m.Call.KIND: 8 * MIB,
    m.Accept.KIND: KIB,
    m.Feedback.KIND: 64 * KIB,
    m.Outcome.KIND: 8 * MIB,
    m.ResultAck.KIND: 64 * KIB,
    m.Cancel.KIND: 4 * KIB,
    m.Event.KIND: 2 * MIB,
    m.EventAck.KIND: KIB,
    m.Subscribe.KIND: 64 * KIB,
    m.Command.KIND: 64 * KIB,
    m.Answer.KIND: MIB,
    m.Ping.KIND: 32,
    m.Pong.KIND: 32,
    m.Tick.KIND: LARGEST,
    m.Bye.KIND: 4 * KIB,
    m.Challenge.KIND: 128,
    m.Proof.KIND: 128,
    m.StreamOpen.KIND: 2 * KIB,
    m.SetPoint.KIND: 4 * KIB,
    m.Withdraw.KIND: 16,
}
"""Largest body of each kind (bytes, without the MAC).

A value of the global memory (1 MiB) fits into CALL and RESULT. Images and other large data have
connections of their own.
"""

MAX_VALUES = 1 << 17
"""Most values in one message, counted over all its arrays and maps: 1 MiB of floats.

Together with the limit of bytes it bounds how long other callers wait while one message is decoded:
about 30 ms at worst.
"""
MAX_VALUES_OF_OUTCOME = MOST_VALUES
"""The same for a result, since the score of a long mission run is one. The worst that was tried
takes a node 40 ms from its worker to the caller, and the caller 25 ms (2-core PC)."""
ENTRY = 6
"""How many values one entry of a map counts as: its key must be checked, hashed and inserted."""
MAX_CONTAINERS_OF_TICK = 100_000
"""Most arrays and maps in a TICK, which only members of one lock-step cell send to each other."""
UNCOUNTED = MAX_CONTAINERS
"""Bodies of up to this many bytes are decoded without counting: each array or map takes at least
one byte, so a body this short cannot hold too many of them."""
_SELDOM = frozenset((m.Call.KIND, m.Outcome.KIND, m.Subscribe.KIND))
"""Kinds whose last field is a bool that is left out when it is false, so a peer that does not know
the field still reads the message."""
_COUNTED = frozenset((m.Call.KIND, m.Outcome.KIND, m.Event.KIND, m.Answer.KIND))
_NUMBERS = frozenset((float, int))
_TEXT = frozenset((str,))
_TICK = Tick.KIND
_ARRAY, _MESSAGE = 1, 2
"""msgpack extension types inside a Tick: an array of numbers, and a message."""


class ProtocolError(Exception):
    """The other side broke the protocol, or a message cannot be sent.

    `code` is for programs, `text` for people. `before` holds the messages that arrived complete
    before the fault.
    """

    def __init__(self, code: str, text: str, before: Iterable[Message] = ()) -> None:
        self.code = code
        self.text = text
        self.before = tuple(before)
        super().__init__(code, text, self.before)

    def __str__(self) -> str:
        return f"{self.code}: {self.text}"


class _FieldError(ValueError):
    """One field is wrong; `decode` adds which field."""


class _LongNameError(_FieldError):
    """A name is longer than NAME_LENGTH."""


def _name(value: str) -> str:
    if len(value) > NAME_LENGTH:
        raise _LongNameError(f"expected at most {NAME_LENGTH} characters, found {len(value):,}")
    return value


def _count(value: int) -> int:
    if not 0 <= value < COUNT_END:
        raise _FieldError("expected an integer from 0 to 2^63 - 1")
    return value


def _duration(value: float) -> float:
    if not 0.0 <= value < math.inf:
        raise _FieldError("expected a finite number >= 0")
    return value


def _duration_or_none(value: float | None) -> float | None:
    return None if value is None else _duration(value)


def _plain_map(value: dict[Any, Any]) -> dict[Any, Any]:
    if value:
        inspect(value)
    return value


def _names(value: list[Any]) -> tuple[str, ...]:
    if not _TEXT.issuperset(map(type, value)):
        raise _FieldError("expected an array of str")
    _name(max(value, key=len, default=""))
    return tuple(value)


def _numbers(value: list[Any]) -> tuple[float, ...]:
    if not _NUMBERS.issuperset(map(type, value)) or not all(map(math.isfinite, value)):
        raise _FieldError("expected an array of finite numbers")
    return tuple(map(float, value))


@cache
def _leaves(numpy: ModuleType | None) -> frozenset[type]:
    """Return what may stand in an envelope beside plain data: messages, and arrays if numpy was
    imported, which decoding an array does."""
    return _MESSAGES if numpy is None else _MESSAGES | {numpy.ndarray}


def _executed(value: str) -> Executed:
    found = EXECUTED.get(value)
    if found is None:
        raise _FieldError("expected yes, no or unknown")
    return found


def _posted_all(value: tuple[Any, ...]) -> tuple[Posted, ...]:
    return tuple(map(_posted, value))


def _posted(item: Any) -> Posted:
    if (
        type(item) is not tuple
        or tuple(map(type, item[:6])) != (int, int, str, str, str, str)
        or len(item) != 7
    ):
        raise _FieldError("expected an envelope of seven fields")
    due, sequence, party, source, target, channel, body = item
    inspect(body, _leaves(sys.modules.get("numpy")))
    return Posted(
        _count(due),
        _count(sequence),
        Envelope(party, source, target, channel, _body_in(channel, body)),
    )


def _body_in(channel: str, body: Any) -> Any:
    if channel != "can" or type(body) is not tuple:
        return body
    if len(body) == 2 and type(body[0]) is int and type(body[1]) is bytes:
        return Frame(*body)
    return tuple(_body_in(channel, item) for item in body)


# Types that msgpack packs as one of the types above: a tuple as an array, an int where a float is
# expected.
_ALSO: Mapping[type, tuple[type, ...]] = {list: (tuple,), float: (int,)}


class _Field(NamedTuple):
    """The wire types of one annotation, and the check beyond the type."""

    types: tuple[type, ...]
    check: Callable[[Any], Any] | None

    @property
    def out(self) -> tuple[type, ...]:
        """Types that the field may have in a message that is to be sent."""
        return (*self.types, *_ALSO.get(self.types[0], ()))


_FIELDS = {
    "str": _Field((str,), _name),
    "bytes": _Field((bytes,), None),
    "bool": _Field((bool,), None),
    "int": _Field((int,), _count),
    "float": _Field((float,), _duration),
    "float | None": _Field((float, type(None)), _duration_or_none),
    "Executed": _Field((str,), _executed),
    "Mapping[str, Any]": _Field((dict,), _plain_map),
    "tuple[str, ...]": _Field((list,), _names),
    "tuple[float, ...]": _Field((list,), _numbers),
    "tuple[Any, ...]": _Field((tuple,), _posted_all),
}
_FREE_TEXT = frozenset(("text", "reason"))
_SHORTER = {"cause": "put long words into the text"}
"""The remedy for a name that is too long, by field."""


class _Spec:
    """How the fields of one kind of message are read and written."""

    __slots__ = (
        "checks",
        "cls",
        "fields",
        "long_checks",
        "names",
        "out",
        "read",
        "required",
        "types",
    )

    def __init__(self, cls: type[Message]) -> None:
        self.cls: Callable[..., Message] = cls
        self.names = list(cls.__struct_fields__)
        self.fields = [_FIELDS[cls.__annotations__[name]] for name in self.names]
        self.required = len(self.names) - len(cls.__struct_defaults__)
        self.types = tuple(field.types[0] for field in self.fields)
        self.checks = self._checks(short=True)
        self.long_checks = self._checks(short=False)
        self.read = _reader(self.names)
        self.out = [
            (index + 1, name, field, field.check is not _name or name not in _FREE_TEXT)
            for index, (name, field) in enumerate(zip(self.names, self.fields, strict=True))
        ]
        """Position in the array, name, field, and whether more than the type is checked."""

    def _checks(self, short: bool) -> tuple[tuple[int, Callable[[Any], Any]], ...]:
        """Return the checks by position. `short`: the body is shorter than the longest name, so no
        name needs to be measured."""
        return tuple(
            (index, field.check)
            for index, (name, field) in enumerate(zip(self.names, self.fields, strict=True))
            if field.check is not None
            and not (field.check is _name and (short or name in _FREE_TEXT))
        )


def _reader(names: list[str]) -> Callable[[Any], tuple[Any, ...]]:
    if len(names) > 1:
        return attrgetter(*names)
    return lambda message: tuple(getattr(message, name) for name in names)


_SPECS: dict[int, _Spec] = {cls.KIND: _Spec(cls) for cls in get_args(Message)}
_MESSAGES: frozenset[type] = frozenset(get_args(Message))
_pack = msgpack.Packer(buf_size=64 * KIB).pack
unpack = msgpack.unpackb


def encode(message: Message) -> bytes:
    """Encode a message as the body of a frame, without length and MAC.

    Raises ProtocolError for a message that the other side would have to refuse, because a refusal
    costs the connection: the message is too large, a name is too long, a number is out of range, or
    data is not plain. Data in calls and results must have been converted by `plain` before.
    """
    kind = message.KIND
    writer = WRITERS.get(kind)
    row: Sequence[Any] | None = writer(message) if writer is not None else None
    try:
        if row is None and kind == _TICK:
            return _small_enough(
                message, msgpack.packb([kind, *_tick_out(message)], default=_extension)
            )
        if row is None:
            row = _row(message)
        body: bytes = _pack(row)
    except (TypeError, ValueError, OverflowError) as fault:
        raise _unpackable(message, fault) from None
    if len(body) > LIMITS[kind] or len(body) > UNCOUNTED:
        return _small_enough(message, body, row)
    return body


def _unpackable(message: Message, fault: Exception) -> ProtocolError:
    if isinstance(fault, UnicodeEncodeError):
        found = f"U+{ord(fault.object[fault.start]):04X} in {fault.object[:40]!r}"
        return ProtocolError("unencodable", f"expected text that UTF-8 can carry, found {found}")
    return ProtocolError("unencodable", f"{type(message).__name__}: {fault}")


def _small_enough(message: Message, body: bytes, row: Sequence[Any] = ()) -> bytes:
    limit = LIMITS[message.KIND]
    if len(body) > limit:
        text = f"{type(message).__name__}: {len(body):,} bytes are above its limit of {limit:,}"
        raise ProtocolError("too_large", text)
    if len(body) > UNCOUNTED and message.KIND in _COUNTED:
        _refuse_too_many(message, row)
    return body


def _row(message: Message) -> list[Any]:
    """Return the array of a message's body, with each field checked as the receiver will check it.
    Raises ProtocolError."""
    kind = message.KIND
    spec = _SPECS[kind]
    row = [kind, *spec.read(message)]
    for index, name, field, checks in spec.out:
        value = row[index]
        try:
            if not isinstance(value, field.out) or (
                type(value) is bool and bool not in field.types
            ):
                raise _FieldError(
                    f"expected a {field.types[0].__name__}, found a {type(value).__name__}"
                )
            if checks and field.check is not None:
                field.check(value)
        except (_FieldError, NotPlainError, OverflowError) as fault:
            remedy = f": {_SHORTER[name]}" if name in _SHORTER else ""
            code = "too_large" if isinstance(fault, _LongNameError) else "unencodable"
            raise ProtocolError(code, f"{name}: {fault}{remedy}") from None
    return row[:-1] if kind in _SELDOM and not row[-1] else row


def _refuse_too_many(message: Message, row: Sequence[Any]) -> None:
    """Raise ProtocolError for a message with too many values; the receiver would break the
    connection for it."""
    try:
        _count_in(row, _Counter(MAX_CONTAINERS, _most_values(message.KIND)))
    except _FieldError as fault:
        raise ProtocolError("too_large", f"{type(message).__name__}: {fault}") from None


def _count_in(value: Any, counter: _Counter) -> None:
    """Count the arrays and maps of data that is to be sent as the receiver will. To decode the
    bytes for that would take ten times as long."""
    counter(value)
    if isinstance(value, dict):
        value = value.values()
    if not SCALARS.issuperset(map(type, value)):
        for item in value:
            if isinstance(item, dict | list | tuple):
                _count_in(item, counter)


def encode_all(messages: Iterable[Message]) -> list[bytes]:
    """Encode several messages; the fast kinds without one call of `encode` each. Raises as
    `encode`."""
    bodies: list[bytes] = []
    for message in messages:
        kind = message.KIND
        writer = WRITERS.get(kind)
        if writer is not None and (row := writer(message)) is not None:
            try:
                body = _pack(row)
                if len(body) <= UNCOUNTED:
                    bodies.append(body)
                    continue
            except (TypeError, ValueError, OverflowError):
                pass  # `encode` below raises the error with its cause
        bodies.append(encode(message))
    return bodies


def _tick_out(tick: Any) -> tuple[int, list[Any]]:
    rows = []
    for due, sequence, envelope in tick.envelopes:
        rows.append(
            (
                due,
                sequence,
                envelope.party,
                envelope.source,
                envelope.target,
                envelope.channel,
                envelope.body,
            )
        )
    return tick.number, rows


def _extension(value: Any) -> msgpack.ExtType:
    if is_numpy(value, "ndarray"):
        return msgpack.ExtType(_ARRAY, pack_array(value))
    if type(value) in _MESSAGES and type(value) is not Tick:
        return msgpack.ExtType(_MESSAGE, encode(value))
    raise TypeError(f"a {type(value).__name__} cannot be sent in an envelope")


def _extension_in(code: int, data: bytes) -> Any:
    if code == _ARRAY:
        return unpack_array(data)
    if code == _MESSAGE and kind_of(data) != Tick.KIND:
        return decode(data)
    raise _FieldError(f"unknown extension type {code}")


def no_extension(code: int, data: bytes) -> Any:
    """Refuse an extension type: they are allowed only inside the envelopes of lock step (hook for
    `unpack`)."""
    raise _FieldError(f"unknown extension type {code}")


# 0x91 to 0x9f is a msgpack fixarray of 1 to 15 elements; the kind follows as a positive fixint.
def kind_of(head: bytes | bytearray | memoryview) -> int:
    """Return the kind of the message whose body begins with these (at least 2) bytes. Raises
    ProtocolError for an unknown kind."""
    if len(head) < 2 or not 0x91 <= head[0] <= 0x9F or head[1] not in _SPECS:
        raise ProtocolError(
            "unknown_kind",
            "expected a body that begins with an array of 1 to 15 fields and a known kind",
        )
    return head[1]


def decode(body: bytes | memoryview) -> Message:
    """Decode the body of a frame. Raises ProtocolError and nothing else."""
    kind = kind_of(body)
    limit = LIMITS[kind]
    if len(body) > limit:
        raise ProtocolError(
            "too_large", f"kind {kind}: {len(body)} bytes are above the limit of {limit}"
        )
    return decode_kind(body, kind)


def decode_kind(body: bytes | memoryview, kind: int) -> Message:
    """Decode a body whose kind and length have been checked."""
    reader = READERS.get(kind)
    size = len(body)
    if reader is not None and size <= UNCOUNTED:
        try:
            message = reader(unpack(body, ext_hook=no_extension), size <= NAME_LENGTH)
            if message is not None:
                return message
        except Exception:
            pass  # the table below finds the fault and words it
    return decode_by_table(body, kind, size)


def decode_by_table(body: bytes | memoryview, kind: int, size: int) -> Message:
    """Decode a body of `size` bytes by the table: any kind, and any fault."""
    try:
        small = size <= UNCOUNTED and kind != _TICK
        found = unpack(body, ext_hook=no_extension) if small else _unpack_counted(body, kind)
    except Exception as fault:
        raise ProtocolError("malformed", f"kind {kind}: {_not_readable(fault)}") from None
    return _by_table(list(found), kind, size <= NAME_LENGTH)


def read_fields(fields: list[Any]) -> Message:
    """Return the message of a body that is unpacked already, as `decode` does. Raises
    ProtocolError."""
    kind = fields[0] if fields else None
    if type(kind) is not int or kind not in _SPECS:
        raise ProtocolError("unknown_kind", f"expected a known kind, found {kind!r:.80}")
    reader = READERS.get(kind)
    if reader is not None:
        try:
            message = reader(fields, False)
            if message is not None:
                return message
        except Exception:
            pass  # the table below finds the fault and words it
    return _by_table(fields, kind, short=False)


def _by_table(fields: list[Any], kind: int, short: bool) -> Message:
    """Check unpacked fields by the table. `short`: the body is shorter than the longest name."""
    spec = _SPECS[kind]
    index = 0
    try:
        del fields[0]
        if tuple(map(type, fields)) != spec.types:
            _other_types(spec, fields)
        for index, check in spec.checks if short else spec.long_checks:
            fields[index] = check(fields[index])
    except _FieldError as fault:
        long = "a name is too long: " if isinstance(fault, _LongNameError) else ""
        raise ProtocolError("malformed", f"kind {kind}: {long}{fault}") from None
    except NotPlainError as fault:
        raise ProtocolError("malformed", f"kind {kind}, {spec.names[index]}: {fault}") from None
    except IndexError:
        pass  # the check of a trailing field that was left out; all fields before it have passed
    return spec.cls(*fields)


class _Counter:
    """Count arrays and maps, and the values in them, while a large body is decoded (hook for
    msgpack)."""

    def __init__(self, containers: int, values: int) -> None:
        self.most = self.left = containers
        self.most_values = self.values = values

    def __call__(self, container: Any) -> Any:
        self.left -= 1
        if self.left < 0:
            raise _FieldError(f"more than {self.most} arrays and maps")
        self.values -= len(container) * (ENTRY if isinstance(container, dict) else 1)
        if self.values < 0:
            raise _FieldError(f"more than {self.most_values} values")
        return container


def _most_values(kind: int) -> int:
    return MAX_VALUES_OF_OUTCOME if kind == m.Outcome.KIND else MAX_VALUES


def _not_readable(fault: Exception) -> _FieldError:
    if isinstance(fault, (_FieldError, NotPlainError, ProtocolError)):
        return _FieldError(str(fault))
    if "exceeds max_" in str(fault):
        return _FieldError("more than a message may have values")
    # msgpack raises its own kinds, ValueError, UnicodeDecodeError and RecursionError on bad bytes.
    return _FieldError(f"not msgpack: {type(fault).__name__}")


def _unpack_counted(body: bytes | memoryview, kind: int) -> Any:
    if kind == Tick.KIND:
        counter = (
            _Counter(MAX_CONTAINERS_OF_TICK, ENTRY * len(body)) if len(body) > UNCOUNTED else None
        )
        hooks: dict[str, Any] = {"list_hook": counter, "object_hook": counter}
        return msgpack.unpackb(body, use_list=False, ext_hook=_extension_in, **hooks)
    most = _most_values(kind)
    counter = _Counter(MAX_CONTAINERS, most)
    # The hooks count an array only when it is complete. Until then msgpack's own limits apply: no
    # single array may be longer than all arrays together.
    longest = {"max_array_len": most, "max_map_len": most // ENTRY}
    return msgpack.unpackb(
        body, ext_hook=no_extension, list_hook=counter, object_hook=counter, **longest
    )


def _other_types(spec: _Spec, fields: list[Any]) -> None:
    """Convert fields that differ from the usual types: trailing ones left out, int for float, nil
    where it is allowed."""
    if not spec.required <= len(fields) <= len(spec.fields):
        raise _FieldError(f"expected {len(spec.fields)} fields, found {len(fields)}")
    for position, (value, name, field) in enumerate(
        zip(fields, spec.names, spec.fields, strict=False)
    ):
        if type(value) is int and field.types[0] is float:
            fields[position] = float(value)
        elif type(value) not in field.types:
            raise _FieldError(
                f"{name}: expected a {field.types[0].__name__}, found a {type(value).__name__}"
            )
