"""The base class of cameras: images come only while they are wanted, those of another shape are
refused with the remedy, and the operator sees the last one."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import repeat
from typing import Any, cast

import cv2
import numpy as np
import pytest

from petrobot import CameraDriver, Context, Image, Ports, Result, error, rehearse, success
from petrobot.services.camera import CameraError

SHAPE = (48, 64)


class Source:
    """An image of this shape at each call, with its number as brightness; none while it is cut
    off."""

    def __init__(self) -> None:
        self.shape: tuple[int, ...] = SHAPE
        self.condition, self.rates, self.count = "", list[float](), 0
        self.kind: Any = np.uint8
        self.times: Iterator[Any] = repeat(0.5)

    def start(self, rate: float) -> None:
        if self.condition:
            raise ConnectionError(self.condition)
        self.rates.append(rate)

    def stop(self) -> None:
        self.rates.append(0.0)

    def close(self) -> None:
        self.rates.append(-1.0)

    def newest(self) -> Image | None:
        if self.condition or not self.rates or self.rates[-1] <= 0.0:
            return None
        self.count += 1
        pixels = np.full(self.shape, self.count, self.kind) if self.kind else cast(Any, None)
        return Image(pixels, next(self.times), self.count)


class Eye(CameraDriver):
    """A camera whose images have a known shape."""

    usual_rate = 40.0
    shape: tuple[int, ...] = SHAPE
    shaped_by = "[camera] of eye.toml"


class Silent(Eye):
    """A camera that does not tell its rate."""

    usual_rate = 0.0


def eye(source: Source, kind: type[Eye] = Eye, **table: Any) -> Eye:
    ports = type("Own", (), {"images": lambda self: source, "now": 2.0})()
    return kind({"source": "sim", **table}, cast(Ports, ports))


async def look(ctx: Context[CameraDriver], count: int = 2) -> Result:
    try:
        taken = await ctx.device.take(ctx, count, 0.5)
    except (CameraError, ConnectionError) as fault:
        return error("no_image", str(fault))
    if len(taken) < count:
        return error("no_image", ctx.device.missing(f"{len(taken)} images came"))
    return success(shown=[int(image.pixels.flat[0]) for image in taken])


def test_images_come_only_while_they_are_taken() -> None:
    source = Source()
    camera = eye(source)
    assert rehearse(look, device=camera).result.values == {"shown": [1, 2]}
    assert rehearse(look, device=camera, count=1).result.values == {"shown": [3]}
    assert source.rates == [40.0, 0.0, 40.0, 0.0] and camera.stopped()
    assert camera.state() == {"rate": 0.0, "source": "ok", "images": 3}
    camera.close()
    assert source.rates[-1] == -1.0


def test_an_image_exposed_before_is_not_taken() -> None:
    """As the first one of a camera whose images come late: the arm may still have moved then."""
    source = Source()
    source.times = iter((-0.2, -0.01, 0.1, 0.2))
    assert rehearse(look, device=eye(source)).result.values == {"shown": [3, 4]}


@pytest.mark.parametrize(
    ("trouble", "text"),
    [
        ({"shape": (24, 32)}, "expected images of 64x48, found 32x24; change [camera] of eye.toml"),
        ({"shape": (48, 64, 3)}, "expected images of 64x48, found 64x48x3"),
        ({"kind": np.uint16}, "expected pixels of type uint8, found uint16: convert them in sim"),
        ({"kind": None}, "expected pixels of type uint8, found NoneType"),
        ({"times": repeat(None)}, "expected a time in seconds, found None: correct it in sim"),
        ({"times": repeat(float("nan"))}, "expected a time in seconds, found nan"),
        ({"times": repeat(1.7e9)}, "expected a time of the clock that the class is given, at most"),
        ({"condition": "camera 'x' was lost"}, "was lost"),
    ],
)
def test_what_is_wrong_with_the_images_is_said(trouble: dict[str, Any], text: str) -> None:
    source = Source()
    camera = eye(source)
    for name, value in trouble.items():
        setattr(source, name, value)
    found = rehearse(look, device=camera).result
    assert found.cause == "no_image" and text in found.text, found
    assert camera.stopped() and (not source.rates or source.rates[-1] == 0.0)
    source.shape, source.condition, source.kind = SHAPE, "", np.uint8
    source.times = repeat(0.5)
    assert rehearse(look, device=camera).result.status == "success"


@pytest.mark.parametrize(
    ("shape", "colour"),
    [((48, 64, 3), False), ((48, 64), True), ((48, 64, 4), True), ((64,), False), ((0, 0), False)],
)
def test_images_are_grey_or_coloured_as_the_table_says(
    shape: tuple[int, ...], colour: bool
) -> None:
    """Also those of a user's class, without a driver that knows their size."""
    source = Source()
    camera = eye(source, colour=colour)
    camera.shape, source.shape = (), shape
    text = rehearse(look, device=camera).result.text
    assert text.startswith("camera: expected pixels of shape (height, width"), text
    assert f"found {shape}: correct it in sim" in text


def test_a_source_that_gives_something_else_than_images_is_named() -> None:
    source = Source()
    source.newest = lambda: cast(Image, np.zeros(SHAPE, np.uint8))  # type: ignore[method-assign]
    text = rehearse(look, device=eye(source)).result.text
    assert "expected a petrobot.Image, found ndarray without pixels: correct it in sim" in text


def test_why_images_are_missing_is_said() -> None:
    """By an action that began before the camera was lost."""
    source = Source()

    async def cut_off(ctx: Context[CameraDriver]) -> Result:
        ctx.device.start()
        source.condition = "camera 'x' was lost"
        assert await ctx.device.read(ctx, 0.3) is None
        return error("no_image", ctx.device.missing("no image for 0.3 s"))

    camera = eye(source)
    found = rehearse(cut_off, device=camera).result
    assert found.text == "no image for 0.3 s: camera 'x' was lost"
    assert camera.state()["source"] == "camera 'x' was lost" and camera.hold(0.0) == "held"
    camera.stop(0.0)
    assert camera.stopped()


@pytest.mark.parametrize("rate", [-1.0, 1001.0])
def test_an_impossible_rate_is_refused(rate: float) -> None:
    with pytest.raises(ValueError, match=r"^rate: expected a number from 0 to 1000"):
        eye(Source(), rate=rate)
    with pytest.raises(CameraError, match="usual_rate: expected images/s above 0 and at most 1000"):
        eye(Source(), Silent)
    assert eye(Source(), rate=12.5).rate == 12.5


def test_the_operator_sees_the_last_image() -> None:
    source = Source()
    camera = eye(source, colour=True)
    camera.shape = ()
    source.shape = (48, 64, 3)
    assert camera.picture() == {}
    rehearse(look, device=camera)
    seen = camera.picture()
    shown = cv2.imdecode(np.frombuffer(seen["data"], np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None and shown.shape == (seen["height"], seen["width"], 3) == (48, 64, 3)
    assert abs(float(shown.mean()) - 2.0) < 2.0
    assert (seen["mime"], seen["age"]) == ("image/jpeg", 1.5)
