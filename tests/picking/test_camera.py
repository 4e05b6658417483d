"""The camera above the table: images of another size are refused with the remedy, and good ones are
taken again afterwards."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from petrobot import Context, Ports, Result, error, rehearse, success
from petrobot.services.comm.streams.image import Image
from petrobot.services.picking.camera import TableCamera
from petrobot.services.picking.model import cell_named

EYE = cell_named().eye


class Source:
    """Images of one size, one each call; none while it is cut off."""

    def __init__(self) -> None:
        self.size, self.count, self.on = (EYE.height, EYE.width), 0, False
        self.condition = ""

    def start(self, rate: float) -> None:
        if self.condition:
            raise ConnectionError(self.condition)
        self.on = True

    def stop(self) -> None:
        self.on = False

    def close(self) -> None:
        self.on = False

    def newest(self) -> Image | None:
        if not self.on or self.condition:
            return None
        self.count += 1
        return Image(np.zeros(self.size, np.uint8), 1e9, self.count)


async def look(ctx: Context[Any]) -> Result:
    try:
        taken = await ctx.device.take(ctx, 2, 0.5)
    except (ValueError, ConnectionError) as fault:
        return error("no_image", str(fault))
    return success(count=len(taken))


@pytest.mark.parametrize(
    ("trouble", "text"),
    [
        (
            {"size": (240, 320)},
            "have shape (240, 320), its numbers say (480, 640): change [camera]",
        ),
        ({"size": (480, 640, 3)}, "have shape (480, 640, 3)"),
        ({"condition": "camera 'x' was lost"}, "was lost"),
    ],
)
def test_what_is_wrong_with_the_images_is_said(trouble: dict[str, Any], text: str) -> None:
    source = Source()
    ports = type("Own", (), {"images": lambda self: source, "now": 0.0})()
    camera = TableCamera({}, cast(Ports, ports))
    for name, value in trouble.items():
        setattr(source, name, value)
    found = rehearse(look, device=camera).result
    assert found.cause == "no_image" and text in found.text, found
    assert camera.stopped() and not source.on
    source.size, source.condition = (EYE.height, EYE.width), ""
    again = rehearse(look, device=camera).result
    assert again.values == {"count": 2}, again
