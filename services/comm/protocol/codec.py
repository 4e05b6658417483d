"""Messages as bytes and back: a msgpack array `[kind, field, ...]` for each, every field checked on
its way in."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import inf
from operator import attrgetter
from typing import Any, Final, NamedTuple, get_args

import msgpack
import numpy as np

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.lockstep.party import Envelope, Posted
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.messages import Call, Executed, Message, Outcome, Tick
from petrobot.services.comm.protocol.plain import (
    LARGEST,
    MAX_CONTAINERS,
    NotPlainError,
    inspect,
    pack_array,
    unpack_array,
)

__all__ = [
    "LIMITS",
    "MAX_CONTAINERS",
    "UNCOUNTED",
    "ProtocolError",
    "decode",
    "decode_by_table",
    "decode_kind",
    "encode",
]


# The kinds that make up nearly all traffic, written and read without the codec's table: the same bytes, a third of the time.

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

__all__ += ["encode_all", "kind_of", "no_extension", "unpack"]

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
"""Largest body of each kind (bytes), the MAC not counted. A value of the global memory (1 MiB) fits
into CALL and RESULT; images and other large data have connections of their own."""

MAX_VALUES = 1 << 17
"""Most values in one message, all that its arrays and maps hold: 1 MiB of floats. Together with the
limit of bytes this is what keeps other callers waiting while one message is read: some 30 ms at the
worst."""
ENTRY = 6
"""Values that an entry of a map counts as: its key is checked, hashed and put in its place."""
MAX_CONTAINERS_OF_TICK = 100_000
"""Of a TICK, which only members of one cell send each other, in lock step."""
UNCOUNTED = MAX_CONTAINERS
"""Bodies up to so many bytes are read without counting what is in them: they cannot hold more."""
_SELDOM = frozenset((m.Call.KIND, m.Outcome.KIND))
"""Kinds whose last field, a bool, is left out when it is false: a peer that does not know it yet is
not bothered with it."""
_COUNTED = frozenset((m.Call.KIND, m.Outcome.KIND, m.Event.KIND, m.Answer.KIND))
_NUMBERS = frozenset((float, int))
_TICK = Tick.KIND
_ARRAY, _MESSAGE = 1, 2
"""msgpack extension types inside Tick: an array of numbers, a message."""


class ProtocolError(Exception):
    """The other side broke the protocol. `code` is for programs, `text` for people; `before` came
    well before the fault."""

    def __init__(self, code: str, text: str, before: Iterable[Message] = ()) -> None:
        super().__init__(f"{code}: {text}")
        self.code = code
        self.text = text
        self.before = tuple(before)


class _FieldError(ValueError):
    """What is wrong with one field; `decode` adds which."""


class _LongNameError(_FieldError):
    """A name that is longer than any."""


def _name(value: str) -> str:
    if len(value) > NAME_LENGTH:
        raise _LongNameError(f"expected at most {NAME_LENGTH} characters, found {len(value):,}")
    return value


def _count(value: int) -> int:
    if not 0 <= value < COUNT_END:
        raise _FieldError("not from 0 to 2^63 - 1")
    return value


def _duration(value: float) -> float:
    if not 0.0 <= value < math.inf:
        raise _FieldError("not a finite number >= 0")
    return value


def _duration_or_none(value: float | None) -> float | None:
    return None if value is None else _duration(value)


def _plain_map(value: dict[Any, Any]) -> dict[Any, Any]:
    if value:
        inspect(value)
    return value


def _names(value: list[Any]) -> tuple[str, ...]:
    for item in value:
        if type(item) is not str:
            raise _FieldError("not an array of str")
        _name(item)
    return tuple(value)


def _numbers(value: list[Any]) -> tuple[float, ...]:
    if not _NUMBERS.issuperset(map(type, value)) or not all(map(math.isfinite, value)):
        raise _FieldError("not an array of finite numbers")
    return tuple(map(float, value))


def _executed(value: str) -> Executed:
    found = EXECUTED.get(value)
    if found is None:
        raise _FieldError("not yes, no or unknown")
    return found


def _posted_all(value: tuple[Any, ...]) -> tuple[Posted, ...]:
    return tuple(map(_posted, value))


def _posted(item: Any) -> Posted:
    if (
        type(item) is not tuple
        or tuple(map(type, item[:6])) != (int, int, str, str, str, str)
        or len(item) != 7
    ):
        raise _FieldError("not an envelope")
    due, sequence, party, source, target, channel, body = item
    inspect(body, _LEAVES)
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


_ALSO: Mapping[type, tuple[type, ...]] = {list: (tuple,), float: (int,)}


class _Field(NamedTuple):
    """How a field of one annotation looks on the wire, and what is checked beyond its type."""

    types: tuple[type, ...]
    check: Callable[[Any], Any] | None

    @property
    def out(self) -> tuple[type, ...]:
        """Types that it may have on its way out: packed they are those on its way in, or taken for
        them."""
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
"""What to do about a name that is too long, by field."""


class _Spec:
    """One kind of message: how its fields are read and written."""

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
        described = dataclasses.fields(cls)
        self.cls: Callable[..., Message] = cls
        self.names = [field.name for field in described]
        self.fields = [_FIELDS[str(field.type)] for field in described]
        self.required = sum(
            field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
            for field in described
        )
        self.types = tuple(field.types[0] for field in self.fields)
        self.checks = self._checks(short=True)
        self.long_checks = self._checks(short=False)
        self.read = _reader(self.names)
        self.out = [
            (index + 1, name, field, field.check is not _name or name not in _FREE_TEXT)
            for index, (name, field) in enumerate(zip(self.names, self.fields, strict=True))
        ]
        """Place in the array, name, field, and whether more than its type is checked."""

    def _checks(self, short: bool) -> tuple[tuple[int, Callable[[Any], Any]], ...]:
        """Checks by position; a body shorter than the longest name needs none of its names
        measured."""
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
_LEAVES: frozenset[type] = frozenset((np.ndarray, *get_args(Message)))
_pack = msgpack.Packer(buf_size=64 * KIB).pack
unpack = msgpack.unpackb


def encode(message: Message) -> bytes:
    """Body of a frame, without length and MAC: what `decode` takes, and nothing else.

    Raises ProtocolError for a message that the other side would have to refuse, since a refusal
    costs the connection: too large, a name too long, a number out of its range, data that is not
    plain. Data in calls and results must have been through `plain`.
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
        return _small_enough(message, body)
    return body


def _unpackable(message: Message, fault: Exception) -> ProtocolError:
    if isinstance(fault, UnicodeEncodeError):
        found = f"U+{ord(fault.object[fault.start]):04X} in {fault.object[:40]!r}"
        return ProtocolError("unencodable", f"expected text that UTF-8 can carry, found {found}")
    return ProtocolError("unencodable", f"{type(message).__name__}: {fault}")


def _small_enough(message: Message, body: bytes) -> bytes:
    limit = LIMITS[message.KIND]
    if len(body) > limit:
        text = f"a {type(message).__name__} of {len(body):,} bytes is above its limit of {limit:,}"
        raise ProtocolError("too_large", text)
    if len(body) > UNCOUNTED and message.KIND in _COUNTED:
        _refuse_too_many(body, message)
    return body


def _row(message: Message) -> list[Any]:
    """The array that is a message's body, each field checked as the other side will check it.
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


def _refuse_too_many(body: bytes, message: Message) -> None:
    """What the other side would break the connection for ends the message here."""
    try:
        _unpack_counted(body, message.KIND)
    except Exception as fault:
        raise ProtocolError(
            "too_large", f"a {type(message).__name__}: {_not_readable(fault)}"
        ) from None


def encode_all(messages: Iterable[Message]) -> list[bytes]:
    """`encode` of each, the kinds that make up nearly all traffic without a call of it. Raises as
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
                pass  # `encode` says what is wrong with it
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
    if isinstance(value, np.ndarray):
        return msgpack.ExtType(_ARRAY, pack_array(value))
    if type(value) in _LEAVES and type(value) is not Tick:
        return msgpack.ExtType(_MESSAGE, encode(value))
    raise TypeError(f"a {type(value).__name__} cannot travel in an envelope")


def _extension_in(code: int, data: bytes) -> Any:
    if code == _ARRAY:
        return unpack_array(data)
    if code == _MESSAGE and kind_of(data) != Tick.KIND:
        return decode(data)
    raise _FieldError(f"unknown extension type {code}")


def no_extension(code: int, data: bytes) -> Any:
    """For `unpack`: no extension type may stand outside an envelope of lock step."""
    raise _FieldError(f"unknown extension type {code}")


def kind_of(head: bytes | bytearray | memoryview) -> int:
    """Kind of the message whose body begins so (2 bytes needed). Raises ProtocolError if there is
    no such kind."""
    if len(head) < 2 or not 0x91 <= head[0] <= 0x9F or head[1] not in _SPECS:
        raise ProtocolError(
            "unknown_kind", "a body begins with an array of 1 to 15 fields and a known kind"
        )
    return head[1]


def decode(body: bytes | memoryview) -> Message:
    """The message in a frame's body. Raises ProtocolError and nothing else."""
    kind = kind_of(body)
    limit = LIMITS[kind]
    if len(body) > limit:
        raise ProtocolError(
            "too_large", f"kind {kind}: {len(body)} bytes are above the limit of {limit}"
        )
    return decode_kind(body, kind)


def decode_kind(body: bytes | memoryview, kind: int) -> Message:
    """`decode` of a body whose kind and length have been checked."""
    reader = READERS.get(kind)
    size = len(body)
    if reader is not None and size <= UNCOUNTED:
        try:
            message = reader(unpack(body, ext_hook=no_extension), size <= NAME_LENGTH)
            if message is not None:
                return message
        except Exception:
            pass  # whatever it is, the table finds and names it
    return decode_by_table(body, kind, size)


def decode_by_table(body: bytes | memoryview, kind: int, size: int) -> Message:
    """`decode_kind` of a body of `size` bytes that no reader of `frequent.py` takes."""
    spec = _SPECS[kind]
    index = 2  # the map: all that a reader can find fault with
    try:
        try:
            if size <= UNCOUNTED and kind != _TICK:
                fields = unpack(body, ext_hook=no_extension)
            else:
                fields = list(_unpack_counted(body, kind))
        except Exception as fault:
            raise _not_readable(fault) from None
        del fields[0]
        if tuple(map(type, fields)) != spec.types:
            _other_types(spec, fields)
        for index, check in spec.checks if size <= NAME_LENGTH else spec.long_checks:
            fields[index] = check(fields[index])
    except _FieldError as fault:
        long = "a name is longer than it may be: " if isinstance(fault, _LongNameError) else ""
        raise ProtocolError("malformed", f"kind {kind}: {long}{fault}") from None
    except NotPlainError as fault:
        raise ProtocolError("malformed", f"kind {kind}, {spec.names[index]}: {fault}") from None
    except IndexError:
        # A check of a trailing field that was left out: all before it have passed.
        pass
    return spec.cls(*fields)


class _Counter:
    """Counts arrays and maps, and what they hold, while a large body is read."""

    def __init__(self, containers: int) -> None:
        self.most = self.left = containers
        self.values = MAX_VALUES

    def __call__(self, container: Any) -> Any:
        self.left -= 1
        if self.left < 0:
            raise _FieldError(f"more than {self.most} arrays and maps")
        self.values -= len(container) * (ENTRY if type(container) is dict else 1)
        if self.values < 0:
            raise _FieldError(_TOO_MANY)
        return container


_TOO_MANY = f"more than {MAX_VALUES} values"


def _not_readable(fault: Exception) -> _FieldError:
    if isinstance(fault, (_FieldError, NotPlainError, ProtocolError)):
        return _FieldError(str(fault))
    if "exceeds max_" in str(fault):
        return _FieldError(_TOO_MANY)
    # msgpack raises its own kinds, ValueError, UnicodeDecodeError and RecursionError on bad bytes.
    return _FieldError(f"not msgpack: {type(fault).__name__}")


def _unpack_counted(body: bytes | memoryview, kind: int) -> Any:
    if kind == Tick.KIND:
        counter = _Counter(MAX_CONTAINERS_OF_TICK) if len(body) > UNCOUNTED else None
        hooks: dict[str, Any] = {"list_hook": counter, "object_hook": counter}
        if counter is not None:
            counter.values = ENTRY * len(body)
        return msgpack.unpackb(body, use_list=False, ext_hook=_extension_in, **hooks)
    counter = _Counter(MAX_CONTAINERS)
    # Arrays within arrays are counted when they end; none of those that have not ended may be
    # longer than all may be together.
    longest = {"max_array_len": MAX_VALUES, "max_map_len": MAX_VALUES // ENTRY}
    return msgpack.unpackb(
        body, ext_hook=no_extension, list_hook=counter, object_hook=counter, **longest
    )


def _other_types(spec: _Spec, fields: list[Any]) -> None:
    """Settle fields that differ from the usual types: trailing ones left out, int for float, nil
    where it may stand."""
    if not spec.required <= len(fields) <= len(spec.fields):
        raise _FieldError(f"{len(fields)} fields instead of {len(spec.fields)}")
    for position, (value, name, field) in enumerate(
        zip(fields, spec.names, spec.fields, strict=False)
    ):
        if type(value) is int and field.types[0] is float:
            fields[position] = float(value)
        elif type(value) not in field.types:
            raise _FieldError(
                f"{name} is a {type(value).__name__}, not a {field.types[0].__name__}"
            )
