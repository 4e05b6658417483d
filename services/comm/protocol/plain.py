"""Plain data: what may stand in a message's arguments, values and data.

Plain is None, bool, int (64 bits), float, str, bytes, list and dict with str keys, nested at most
`DEPTH` deep. Arrays of numbers (`ndarray` of uint8 or float64) are plain only inside the envelopes
of lock step. Data is checked by the sender (`plain`) and by the receiver (`inspect`).
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from types import NoneType
from typing import TYPE_CHECKING, Any

# numpy is imported where it is used: importing it takes a third of the time in which a worker
# starts, and many nodes and workers never see an array.
if TYPE_CHECKING:
    from numpy.typing import NDArray

DEPTH = 32
"""Deepest nesting of plain data."""

LARGEST = 16 << 20
"""Size of the largest message (bytes)."""
MOST_VALUES = 1 << 19
"""Most values in a message of the kind that may have most of them (a result)."""
MAX_CONTAINERS = 20_000
"""Most arrays and maps in one message. Each takes one byte on the wire, but about 70 bytes in
memory."""

SCALARS = frozenset((NoneType, bool, int, float, str, bytes))
_SIMPLE = SCALARS - {int}
_ROWS = frozenset((list, tuple))
_INT_MIN, _INT_MAX = -(2**63), 2**64 - 1
_INT64 = 2**63
_KEY, _SHORT_INT = 60, 200
"""Characters of a key, and bits of an integer, that an error message shows."""
_MOST_FOREIGN = 100_000
"""Most items of a mapping that is not a dict, because its iterator may never end."""

# Calling the method of the base class copies the real content of a subclass, even if the subclass
# overrides `__str__` or `__iter__`.
_BASES: tuple[tuple[type, Callable[[Any], Any]], ...] = (
    (str, str.__str__),
    (bytes, lambda value: b"".join((value,))),
    (int, int.__int__),
    (float, float.__float__),
    (dict, lambda value: dict(dict.items(value))),
    (list, lambda value: list.__getitem__(value, slice(None))),
    (tuple, lambda value: tuple.__getitem__(value, slice(None))),
)
_NUMPY_KINDS = "biufUS"
"""Kinds of numpy scalars that are numbers or text. A date would silently become a number."""
_DTYPES: Mapping[int, str] = {1: "|u1", 2: "<f8"}
"""`dtype.str` of the arrays that may be sent, by its code on the wire."""
_CODES = {dtype: code for code, dtype in _DTYPES.items()}
_MAX_DIMENSIONS = 4


class NotPlainError(TypeError):
    """A value that no message can carry. The text says where it is in the data and what to do."""


def plain(value: Any, where: str = "value") -> Any:
    """Return a copy of the data in plain types: tuples become lists, numpy scalars Python numbers.

    The sender calls it, so a bad value is refused where it was made, and the receiver sees the same
    types whether it lives in this process or in another. `where` names the data in the error.
    Raises NotPlainError. Whether the whole message is small enough is checked by `codec.encode`.
    """
    left = [MAX_CONTAINERS]
    return (
        _plain_dict(value, where, DEPTH, left)
        if type(value) is dict
        else _plain(value, where, DEPTH, left)
    )


def _plain(value: Any, where: str, depth: int, left: list[int]) -> Any:
    """Copy one value. `left` counts down the containers: data that contains itself would never
    end."""
    kind = type(value)
    if kind in _SIMPLE:
        return value
    if kind is int:
        if not _INT_MIN <= value <= _INT_MAX:
            shown = value if value.bit_length() <= _SHORT_INT else f"of {value.bit_length():,} bits"
            raise NotPlainError(
                f"{where}: the integer {shown} does not fit in 64 bits; use a float or a text"
            )
        return value
    if kind is not list and kind is not tuple and kind is not dict:
        return _plain_other(value, where, depth, left)
    if depth == 0:
        raise NotPlainError(f"{where}: nested deeper than {DEPTH} levels; flatten it")
    left[0] -= 1
    if left[0] < 0 or len(value) > MOST_VALUES:
        most = f"{MAX_CONTAINERS:,} lists and dicts" if left[0] < 0 else f"{MOST_VALUES:,} items"
        raise NotPlainError(f"{where}: more than {most}; store them in a file and give its name")
    return (
        _plain_dict(value, where, depth, left)
        if kind is dict
        else _plain_list(value, where, depth, left)
    )


def _plain_dict(
    value: Mapping[Any, Any], where: str, depth: int, left: list[int]
) -> dict[str, Any]:
    copy: dict[str, Any] = {}
    for key, item in value.items():
        if type(key) is not str:
            raise NotPlainError(f"{where}: the key {_shown(key)} is not a str; use str()")
        kind = type(item)
        if kind in _SIMPLE or (kind is int and -_INT64 <= item < _INT64):
            copy[key] = item  # as `_plain`, without building the name of the position
        elif (
            kind in _ROWS
            and depth > 1
            and left[0] > 0
            and len(item) <= MOST_VALUES
            and (_SIMPLE.issuperset(map(type, item)) or _fits(item))
        ):
            left[0] -= 1
            copy[key] = [*item]  # simple values: one copy without a look at each
        else:
            copy[key] = _plain(item, f"{where}.{key[:_KEY]}", depth - 1, left)
    return copy


def _shown(key: Any) -> str:
    """Return a key as text for an error message, without calling an object's own `repr`."""
    short = type(key) in _SIMPLE or (type(key) is int and key.bit_length() <= _SHORT_INT)
    return repr(key)[:_KEY] if short else f"of type {type(key).__name__}"


def _plain_list(value: Sequence[Any], where: str, depth: int, left: list[int]) -> list[Any]:
    if _SIMPLE.issuperset(map(type, value)) or _fits(value):
        return list(value)
    return [_plain(item, f"{where}[{index}]", depth - 1, left) for index, item in enumerate(value)]


def _fits(value: Sequence[Any]) -> bool:
    """Whether all items are simple or integers of 64 bits, of which there is at least one."""
    if not SCALARS.issuperset(map(type, value)):
        return False
    integers = [item for item in value if type(item) is int]
    return min(integers) >= _INT_MIN and max(integers) <= _INT_MAX


def _plain_other(value: Any, where: str, depth: int, left: list[int]) -> Any:
    if is_numpy(value, "generic"):
        if value.dtype.kind in _NUMPY_KINDS and not is_numpy(item := value.item(), "generic"):
            return _plain(item, where, depth, left)
        raise NotPlainError(f"{where}: a numpy {value.dtype.name} is not plain data; use float()")
    for base, convert in _BASES:
        if isinstance(value, base):
            return _plain(convert(value), where, depth, left)
    if isinstance(value, Mapping):
        items = list(islice(value.items(), _MOST_FOREIGN + 1))
        if len(items) > _MOST_FOREIGN:
            raise NotPlainError(
                f"{where}: a {type(value).__name__} of more than {_MOST_FOREIGN:,} items; "
                "use a dict"
            )
        return _plain(dict(items), where, depth, left)
    remedy = "; use .tolist()" if is_numpy(value, "ndarray") else ""
    raise NotPlainError(f"{where}: a {type(value).__name__} is not plain data{remedy}")


def is_numpy(value: Any, name: str) -> bool:
    """Whether a value is of this class of numpy. Where numpy was never imported, none is."""
    return isinstance(value, getattr(sys.modules.get("numpy"), name, ()))


def inspect(value: Any, extra: frozenset[type] = frozenset(), depth: int = DEPTH) -> None:
    """Check decoded data: raise NotPlainError if it is not plain or nested too deep.

    `extra` are further leaf types that are allowed.
    """
    kind = type(value)
    if kind is dict:
        if depth == 0:
            raise NotPlainError(f"nested deeper than {DEPTH} levels")
        for key, item in value.items():
            if type(key) is not str:
                raise NotPlainError("a key of a map is not a str")
            inner = type(item)
            if inner not in SCALARS and not (
                inner is list and depth > 1 and SCALARS.issuperset(map(type, item))
            ):
                inspect(item, extra, depth - 1)
    elif kind is list or kind is tuple:
        if depth == 0:
            raise NotPlainError(f"nested deeper than {DEPTH} levels")
        if not SCALARS.issuperset(map(type, value)):
            for item in value:
                if type(item) not in SCALARS:
                    inspect(item, extra, depth - 1)
    elif kind not in SCALARS and kind not in extra:
        raise NotPlainError(f"a {kind.__name__} is not plain data")


def pack_array(array: NDArray[Any]) -> bytes:
    """Encode an array: dtype code, number of dimensions, u32 lengths, then the numbers in C order.

    Raises NotPlainError.
    """
    code = _code(array)
    return struct.pack(f">BB{array.ndim}I", code, array.ndim, *array.shape) + array.tobytes()


def copy_array(array: NDArray[Any]) -> NDArray[Any]:
    """Return what `unpack_array(pack_array(array))` would return, read-only, at the cost of one
    copy.

    Raises NotPlainError.
    """
    import numpy as np

    _code(array)
    copy: NDArray[Any] = np.frombuffer(array.tobytes(), array.dtype).reshape(array.shape)
    return copy


def _code(array: NDArray[Any]) -> int:
    code = _CODES.get(array.dtype.str)
    if code is None or array.ndim > _MAX_DIMENSIONS:
        raise NotPlainError(
            f"an array of {array.dtype} with {array.ndim} dimensions: only uint8 or float64, "
            "at most 4"
        )
    return code


def unpack_array(data: bytes) -> NDArray[Any]:
    """Decode the bytes of `pack_array`; the result is read-only. Raises NotPlainError on anything
    else."""
    if (
        len(data) < 2
        or data[0] not in _DTYPES
        or data[1] > _MAX_DIMENSIONS
        or len(data) < 2 + 4 * data[1]
    ):
        raise NotPlainError("malformed array")
    import numpy as np

    dtype = np.dtype(_DTYPES[data[0]])
    start = 2 + 4 * data[1]
    shape = struct.unpack(f">{data[1]}I", data[2:start])
    count = 1
    for length in shape:
        count *= length
    if count * dtype.itemsize != len(data) - start:
        raise NotPlainError("malformed array: its length does not fit its shape")
    array: NDArray[Any] = np.frombuffer(data, dtype, offset=start).reshape(shape)
    return array
