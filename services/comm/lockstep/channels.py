"""Bodies of envelopes that are not protocol messages: CAN frames, images, set points and controls.

In lock step a node and the laboratory exchange them instead of a bus, a camera's socket and a
stream's socket:

- "can": all frames that one port sent in a tick, from a device to the laboratory and back, as a
  tuple of `Frame`;
- "serial": the bytes that one end of a serial line sent in a tick, from a device to the laboratory
  and back;
- "tcp": the bytes that one end of a TCP connection sent in a tick (`tcp_body`); the first ones of a
  connection, perhaps none, come from the device and open it;
- "control": from a device to the laboratory, the rate at which it wants images (`images_wanted`);
- "image": from the laboratory to a device (`image_body`), with its age when it was sent, as on the
  wire;
- "stream": a set point from a stream to the device that receives it (`set_point_body`).

Source and target are endpoint names: the device on one side, the laboratory's node on the other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.streams.image import Image


class ImagesWanted(NamedTuple):
    """A device wants images at `rate` (1/s; 0: none). `generation` counts its requests: images of
    an earlier request are dropped."""

    rate: float
    generation: int


class SetPointBody(NamedTuple):
    """A set point on its way: stream, values, age of the values at the sender (s), period of the
    stream (s)."""

    stream: str
    values: tuple[float, ...]
    held: float
    period: float


def can_body(frames: Iterable[Frame]) -> tuple[Frame, ...]:
    """Return the body of a "can" envelope."""
    return tuple(frames)


def read_can(body: Any) -> tuple[Frame, ...]:
    """Return the frames of a "can" envelope, also of one that holds a single frame."""
    if type(body) is tuple and body and type(body[0]) is Frame:
        return body  # as it was sent in this process: the cell has looked at each frame
    if isinstance(body, Frame):
        return (body,)
    return tuple(Frame(*frame) for frame in body)


def tcp_body(port: int, number: int, data: bytes) -> tuple[int, int, bytes]:
    """Return the body of a "tcp" envelope. `number` counts the connections of a device to this
    port: a new one ends the one before it."""
    return port, number, data


def read_tcp(body: Sequence[Any]) -> tuple[int, int, bytes]:
    """Return port, number and bytes of a "tcp" envelope."""
    port, number, data = body
    return port, number, data


def images_wanted(rate: float, generation: int) -> Mapping[str, Any]:
    """Return the body of a "control" envelope to the laboratory."""
    return {"images": float(rate), "generation": generation}


def read_images_wanted(body: Mapping[str, Any]) -> ImagesWanted | None:
    """Return the request in a "control" envelope, None if it is about something else."""
    if "images" not in body:
        return None
    return ImagesWanted(float(body["images"]), int(body["generation"]))


def image_body(
    pixels: NDArray[np.uint8], age: float, sequence: int, generation: int
) -> Mapping[str, Any]:
    """Return the body of an "image" envelope.

    `pixels` are grey levels (height, width); `age` is the time since mid-exposure when it is sent
    (s).
    """
    return {"pixels": pixels, "age": float(age), "sequence": sequence, "generation": generation}


def read_image(body: Mapping[str, Any], now: float) -> tuple[Image, int]:
    """Return the image of an "image" envelope, with its time on the receiver's clock, and the
    generation of the request that it answers."""
    return Image(body["pixels"], now - body["age"], body["sequence"]), body["generation"]


def set_point_body(
    stream: str, values: Sequence[float], held: float, period: float
) -> tuple[Any, ...]:
    """Return the body of a "stream" envelope."""
    return (stream, tuple(float(v) for v in values), float(held), float(period))


def read_set_point(body: Sequence[Any]) -> SetPointBody:
    """Return the set point of a "stream" envelope."""
    stream, values, held, period = body
    return SetPointBody(stream, tuple(values), held, period)
