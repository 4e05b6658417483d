"""RTDE, protocol 2, as its client: packages, recipes and the state of one connection (sans-I/O).

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide". All numbers are big endian; a
package is its size (uint16, with these three bytes), its type (a letter) and its payload.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

VERSION = 2
REQUEST_VERSION, DATA = "V", "U"
OUTPUTS, INPUTS, START, PAUSE = "O", "I", "S", "P"
LETTERS = frozenset("VvMUOISP")
FORMS: Mapping[str, str] = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}


RATE = 125.0
"""How often the controller sends its outputs (Hz)."""


class RtdeError(ValueError):
    """The other end does not follow the protocol, or refuses a request; the text says which."""


def package(letter: str, payload: bytes = b"") -> bytes:
    """Return one package."""
    return struct.pack(">HB", 3 + len(payload), ord(letter)) + payload


def packages(buffer: bytearray) -> Iterator[tuple[str, bytes]]:
    """Remove the complete packages from a buffer and return them. Raises RtdeError for malformed
    ones."""
    while len(buffer) >= 3:
        size, letter = struct.unpack_from(">HB", buffer)
        if size < 3 or chr(letter) not in LETTERS:
            raise RtdeError(f"expected an RTDE package, got the bytes {bytes(buffer[:8])!r}")
        if len(buffer) < size:
            return
        payload = bytes(buffer[3:size])
        del buffer[:size]
        yield chr(letter), payload


class Recipe:
    """The fields of a data package, in order."""

    def __init__(self, fields: Mapping[str, str], types: Sequence[str]) -> None:
        """`fields`: name and type of each. Raises RtdeError for one that the controller does not
        have, or has with another type, or that is in use."""
        found = dict(zip(fields, types, strict=False))
        if used := [name for name, kind in found.items() if kind == "IN_USE"]:
            raise RtdeError(f"another client or a fieldbus writes {', '.join(used[:2])}: end it")
        bad = [f"{n} as {fields[n]} ({kind})" for n, kind in found.items() if kind != fields[n]]
        if bad or len(fields) != len(types):
            raise RtdeError(f"the controller does not give {', '.join(bad) or 'all fields'}")
        self.names = tuple(fields)
        self._forms = [struct.Struct(f">{FORMS[t]}") for t in types]
        self.size = sum(form.size for form in self._forms)

    def unpack(self, data: bytes) -> dict[str, Any]:
        """Return the values by name. Raises RtdeError for another length, and for numbers that are
        not finite: they would become set points."""
        if len(data) != self.size:
            raise RtdeError(f"expected {self.size} bytes of data, got {len(data)}")
        values, at = dict[str, Any](), 0
        for name, form in zip(self.names, self._forms, strict=True):
            found = form.unpack_from(data, at)
            if not all(map(math.isfinite, found)):
                raise RtdeError(f"{name} is {found}")
            values[name], at = (found if len(found) > 1 else found[0]), at + form.size
        return values

    def pack(self, values: Mapping[str, Any]) -> bytes:
        """Return the bytes of these values."""
        rows = zip(self.names, self._forms, strict=True)
        return b"".join(
            form.pack(*(v if isinstance(v := values[name], Sequence) else (v,)))
            for name, form in rows
        )


class Rtde:
    """One connection, from its first byte: requests version and recipes, starts, then receives
    data. `receive` processes bytes, `drain` returns those to send."""

    def __init__(self, outputs: Mapping[str, str], inputs: Sequence[Mapping[str, str]]):
        """`outputs` are received `RATE` times a second; each of `inputs` may be sent. Both are
        types by name."""
        self.data: dict[str, Any] = {}
        """The newest values received."""
        self.count = 0
        """How many data packages were received."""
        self.running = False
        self._outputs, self._inputs = outputs, inputs
        self._recipe: tuple[int, Recipe] | None = None
        self._sent: list[tuple[int, Recipe]] = []
        self._buffer = bytearray()
        self._out = [package(REQUEST_VERSION, struct.pack(">H", VERSION))]

    def receive(self, data: bytes) -> None:
        """Process received bytes. Raises RtdeError."""
        self._buffer += data
        for letter, payload in packages(self._buffer):
            try:
                self._take(letter, payload)
            except (struct.error, IndexError, UnicodeDecodeError) as fault:
                raise RtdeError(f"package {letter!r} cannot be read: {fault}") from fault

    def drain(self) -> bytes:
        """Return the bytes to send."""
        out, self._out = b"".join(self._out), []
        return out

    def send(self, number: int, values: Mapping[str, Any]) -> None:
        """Send the values of an input recipe (counted from 0); do nothing before the start."""
        if self.running:
            identity, recipe = self._sent[number]
            self._out.append(package(DATA, bytes((identity,)) + recipe.pack(values)))

    def _take(self, letter: str, payload: bytes) -> None:
        if letter == DATA:
            if self._recipe is not None and payload[0] == self._recipe[0]:
                self.data, self.count = self._recipe[1].unpack(payload[1:]), self.count + 1
        elif letter == REQUEST_VERSION:
            if payload != b"\x01":
                raise RtdeError(f"the controller refuses RTDE protocol {VERSION}: update it")
            request = struct.pack(">d", RATE) + ",".join(self._outputs).encode()
            self._out.append(package(OUTPUTS, request))
        elif letter == OUTPUTS:
            self._recipe = payload[0], Recipe(self._outputs, _types(payload))
            self._ask_inputs()
        elif letter == INPUTS:
            fields = self._inputs[len(self._sent)]
            self._sent.append((payload[0], Recipe(fields, _types(payload))))
            self._ask_inputs()
        elif letter == START:
            if payload != b"\x01":
                raise RtdeError("the controller refuses to start the data exchange")
            self.running = True
        elif letter == PAUSE:
            self.running = False

    def _ask_inputs(self) -> None:
        if len(self._sent) < len(self._inputs):
            names = ",".join(self._inputs[len(self._sent)])
            self._out.append(package(INPUTS, names.encode()))
        else:
            self._out.append(package(START))


def _types(payload: bytes) -> list[str]:
    """Return the types of a recipe's reply; the list may end with a comma."""
    return payload[1:].decode("ascii").removesuffix(",").split(",")
