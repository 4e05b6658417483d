"""The camera's actions on rendered floors: found, watched to its end, lost, without images."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from petrobot.services.comm.streams.camera import MemoryImages
from petrobot.services.comm.streams.image import Image
from petrobot.services.mobile import seeing
from petrobot.services.mobile.camera import FloorCamera
from petrobot.services.mobile.sight import TrackAhead, TrackEnd
from petrobot.services.rehearsal import Rehearsal, rehearse
from tests.mobile.conftest import DrawnFloor, Photographer

PHOTOGRAPHER = Photographer()
PERIOD = 0.04


class CameraPorts:
    """What the camera's driver may reach."""

    def __init__(self) -> None:
        self.now = 0.0
        self.source = MemoryImages()

    def images(self) -> MemoryImages:
        """The image source."""
        return self.source

    def file(self, path: str) -> bytes:
        """None here."""
        raise FileNotFoundError(path)


class CarriedCamera:
    """A camera that is carried along a floor at `speed` m/s from `s` on; `dark` is when it stops
    sending images (s)."""

    def __init__(
        self,
        floor: DrawnFloor,
        s: float,
        speed: float = 0.5,
        dark: float = 1e9,
        small: bool = False,
    ) -> None:
        self.ports = CameraPorts()
        self.camera = FloorCamera({"source": "sim"}, self.ports)  # type: ignore[arg-type]
        self._floor, self._s, self._speed, self._dark, self._small = floor, s, speed, dark, small
        self._due, self._sequence = 0.0, 0
        self._random = np.random.default_rng(2)

    def world(self, now: float) -> None:
        """An image every 40 ms."""
        self.ports.now = now
        if now >= self._due - 1e-9 and now < self._dark:
            self._due = now + PERIOD
            pixels = PHOTOGRAPHER(
                self._floor, self._floor.at(self._s + self._speed * now, 0.005), self._random
            )
            self.ports.source.put(
                Image(pixels[:60] if self._small else pixels, now - 0.012, self._sequence)
            )
            self._sequence += 1

    def play(self, action: Callable[..., Any], **arguments: Any) -> Rehearsal:
        """Rehearse."""
        streams = {"track_ahead": PERIOD}
        return rehearse(
            action, device=self.camera, world=self.world, streams=streams, limit=40.0, **arguments
        )


@pytest.mark.parametrize("name", ["edges", "ridge", "consensus", "template"])
def test_a_track_is_found_in_three_images(name: str) -> None:
    played = CarriedCamera(DrawnFloor("SSS"), 0.3, 0.1).play(getattr(seeing, f"find_{name}"))
    assert played.result.status == "success" and played.result.values["images"] == 3
    assert (
        abs(played.result.values["offset"]) < 0.02 and abs(played.result.values["heading"]) < 0.06
    )
    ahead = TrackAhead.parse(played.published[-1][2])
    assert 0.0 < ahead.age < 0.05 and len(ahead.points) > 4


@pytest.mark.parametrize("name", ["edges", "ridge", "consensus", "template"])
def test_a_track_is_watched_to_its_interruption(name: str) -> None:
    played = CarriedCamera(DrawnFloor("SSs"), 2.9).play(getattr(seeing, f"watch_{name}"))
    assert played.result.status == "success" and played.result.values["at_t"] is False
    ends = [TrackAhead.parse(values).end for _, _, values in played.published]
    assert {end.kind for end in ends if end is not None} == {TrackEnd.INTERRUPTION}


def test_a_track_is_watched_to_its_t() -> None:
    played = CarriedCamera(DrawnFloor("SS", bar=True), 2.7).play(seeing.watch_edges)
    assert played.result.status == "success" and played.result.values["at_t"] is True
    assert played.result.values["share"] > 0.9


def test_finding_nothing_is_an_error_but_the_stream_shows_that_images_arrive() -> None:
    played = CarriedCamera(DrawnFloor("sss"), 0.3, 0.1).play(seeing.find_edges, timeout=1.0)
    assert (played.result.status, played.result.cause) == ("error", "no_line")
    assert len(played.published) > 20 and all(values[1] == 0.0 for _, _, values in played.published)


def test_a_line_that_vanishes_without_an_end_is_lost() -> None:
    drive = CarriedCamera(DrawnFloor("SSs"), 3.3, 1.0)
    drive._floor = DrawnFloor("S")  # nothing is painted beyond 2 m, and no end was ever in view
    played = drive.play(seeing.watch_edges)
    assert (played.result.status, played.result.cause) == ("error", "no_line")


def test_a_camera_that_stops_is_an_error_and_is_started_again() -> None:
    drive = CarriedCamera(DrawnFloor("SSS"), 0.3, 0.1, dark=0.5)
    played = drive.play(seeing.watch_edges)
    assert (played.result.status, played.result.cause) == ("error", "no_image")
    assert drive.camera.requested == 0.0


def test_images_of_another_size_are_refused() -> None:
    played = CarriedCamera(DrawnFloor("SSS"), 0.3, small=True).play(seeing.find_edges)
    assert (played.result.status, played.result.cause) == ("error", "bad_image")
    assert "160x120" in played.result.text


def test_a_cancelled_watch_withdraws_its_set_points() -> None:
    played = CarriedCamera(DrawnFloor("SSSS"), 0.3, 0.1).play(seeing.watch_edges, cancel_after=0.5)
    assert played.result.cause == "cancelled"
    assert max(time for time, _, _ in played.published) <= 0.51


def test_the_driver_is_a_device_without_commands() -> None:
    camera = FloorCamera({"source": "sim"}, CameraPorts())  # type: ignore[arg-type]
    camera.start()
    assert camera.state()["rate"] == 25.0 and not camera.stopped() and camera.hold(0.0) == "held"
    camera.stop(0.0)
    assert camera.stopped()
    with pytest.raises(ValueError, match="no commands"):
        camera.command(0.0, {})
