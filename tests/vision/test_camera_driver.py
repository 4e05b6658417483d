"""The camera's driver: its config, its interface to the node, and the images it provides."""

from __future__ import annotations

import re
from typing import Any

import cv2
import numpy as np
import pytest

from petrobot.services.action import Result, Status
from petrobot.services.comm.streams.image import Image
from petrobot.services.vision.actions import locate_background, predict_least_squares
from petrobot.services.vision.calibration import DEFAULT, CalibrationFileError
from petrobot.services.vision.camera import CELL, Camera
from petrobot.services.vision.location import FixedThreshold
from tests.vision.bench import BenchContext, BenchPorts, CameraBench, draw_ball, run_action


def test_shipped_files_are_the_default_and_others_can_be_named(bench: CameraBench) -> None:
    usual = Camera({"source": "sim"}, BenchPorts(bench))
    calibration = DEFAULT.read_bytes().replace(b"focal_px = [6", b"focal_px = [7")
    cell = CELL.read_bytes().replace(b"near_edge = 0.62", b"near_edge = 0.70")
    other = Camera(
        {"source": "sim", "calibration": "lab.toml", "cell": "cell.toml"},
        BenchPorts(bench, {"lab.toml": calibration, "cell.toml": cell}),
    )
    assert other.calibrated.optics.focal[0] == usual.calibrated.optics.focal[0] + 100
    assert (usual.view.near_edge, other.view.near_edge) == (0.62, 0.70)
    assert usual.rate == 50.0
    assert usual.period is None


@pytest.mark.parametrize(
    ("config", "files", "error", "text"),
    [
        ({"rate": -1}, {}, ValueError, "0 to 1000 (images/s; 0: the usual rate of this camera)"),
        ({"rate": 5000}, {}, ValueError, "found 5000"),
        ({"rate": "fast"}, {}, ValueError, "rate: expected a number from 0"),
        ({"rat": 50.0}, {}, ValueError, "rat: unknown key; did you mean 'rate'?"),
        (
            {"cell": "cell.toml"},
            {"cell.toml": b"[table"},
            ValueError,
            "cell.toml:1: not valid TOML",
        ),
        (
            {"calibration": "lab.toml"},
            {"lab.toml": b"schema = 1"},
            CalibrationFileError,
            "lab.toml: key 'lens' is missing",
        ),
    ],
)
def test_bad_config_is_refused_with_name_and_remedy(
    bench: CameraBench,
    config: dict[str, Any],
    files: dict[str, bytes],
    error: type[Exception],
    text: str,
) -> None:
    with pytest.raises(error, match=re.escape(text)):
        Camera({"source": "sim", **config}, BenchPorts(bench, files))


def test_the_drivers_interface_to_the_node(context: BenchContext) -> None:
    camera = context.device
    assert camera.stopped() and camera.hold(0.0) == "held"
    assert camera.start()
    assert not camera.stopped() and camera.hold(0.0) == "cannot hold"
    assert not camera.start(), "images already arrive at that rate"
    assert camera.start(25.0) and camera.requested == 25.0
    camera.step(0.0)
    camera.release(0.0)
    camera.stop(0.0)
    camera.stop(0.0)
    assert camera.stopped()
    assert camera.state() == {
        "rate": 0.0,
        "source": "ok",
        "images": 0,
        "background_images": 0,
    }
    with pytest.raises(ValueError, match="no commands"):
        camera.command(0.0, {"verb": "zoom"})
    camera.close()


def test_read_gives_the_newest_image_once(context: BenchContext) -> None:
    camera = context.device
    camera.start(50.0)
    got: list[Image | None] = []

    async def reading() -> Result:
        await context.sleep(0.2)
        got.append(await camera.read(context, 1.0))
        got.append(await camera.read(context, 1.0))
        camera.end()
        got.append(await camera.read(context, 0.1))
        return Result(Status.SUCCESS)

    run_action(context.bench, reading())
    first, second, last = got
    assert first is not None and second is not None and last is None
    assert first.sequence >= 8, "older ones are dropped"
    assert second.sequence == first.sequence + 1
    assert camera.time_of(first.sequence) == first.time
    assert camera.time_of(first.sequence - 1) is None
    assert second.time - first.time == pytest.approx(0.02, abs=0.0041)


def test_detectors_are_made_once(context: BenchContext) -> None:
    camera = context.device
    first = camera.detector("threshold", lambda: FixedThreshold(camera.view))
    assert camera.detector("threshold", lambda: FixedThreshold(camera.view)) is first


def test_a_source_that_cannot_be_opened_is_the_error_no_image(context: BenchContext) -> None:
    from petrobot.services.vision import actions

    class Unplugged:
        def start(self, rate: float) -> None:
            raise ConnectionError("camera source 3 cannot be opened")

        def stop(self) -> None: ...

        def newest(self) -> Image | None:
            return None

        def close(self) -> None: ...

    class Ports(BenchPorts):
        def images(self) -> Any:
            return Unplugged()

    camera = Camera({"source": "sim"}, Ports(context.bench))
    located = run_action(
        context.bench, actions.locate_background(BenchContext(context.bench, camera))
    )
    assert (located.status, located.cause) == (Status.ERROR, "no_image")
    assert "cannot be opened" in located.text
    camera.background.learn(np.zeros((2, 2), np.uint8))


def test_no_image_says_why_if_the_source_knows(context: BenchContext) -> None:
    from petrobot.services.vision import actions

    class Lost:
        condition = "camera 'x' was lost"

        def start(self, rate: float) -> None: ...

        def stop(self) -> None: ...

        def newest(self) -> Image | None:
            return None

        def close(self) -> None: ...

    class Ports(BenchPorts):
        def images(self) -> Any:
            return Lost()

    lost = BenchContext(context.bench, Camera({"source": "sim"}, Ports(context.bench)))
    ball = {"sequence": 0, "age": 0.1, "sigma": 0.001, "places": [[0.3, 2.0, 0.0], [0.1, 1.9, 0.0]]}
    found = [run_action(context.bench, actions.locate_background(lost))]
    found.append(run_action(context.bench, actions.predict_kalman(lost, ball=ball)))
    texts = [(one.cause, one.text) for one in found]
    assert texts == [("no_image", f"no image for {t} s: {Lost.condition}") for t in (0.8, 0.5)]


def test_the_operators_picture_shows_the_detections(context: BenchContext) -> None:
    """It is the newest image as a JPEG with the detected ball and the path to its predicted exit;
    before the first image there is none."""
    camera, bench = context.device, context.bench
    assert camera.picture() == {}
    bench.ball = draw_ball(np.random.default_rng(4), "A")
    located = run_action(bench, locate_background(context))
    assert located.status is Status.SUCCESS
    seen = camera.picture()
    decoded = cv2.imdecode(np.frombuffer(seen["data"], np.uint8), cv2.IMREAD_GRAYSCALE)
    assert decoded is not None and decoded.shape == (seen["height"], seen["width"]) == (480, 640)
    assert np.abs(decoded.astype(float) - bench.picture()).mean() < 20.0
    (found,) = [d for d in seen["detections"] if d["role"] == "found"]
    where = camera.view.to_table(np.array([[found["x"], found["y"]]]))[0]
    _, x, y = located.values["ball"]["places"][-1]
    assert np.hypot(where[0] - x, where[1] - y) < 0.01
    tracked = run_action(bench, predict_least_squares(context, ball=located.values["ball"]))
    path = [d for d in camera.picture()["detections"] if d["kind"] == "path"]
    assert path, camera.picture()["detections"]
    left = camera.view.to_table(np.array([path[0]["points"][-1]]))[0]
    assert np.hypot(*(left - tracked.values["exit"]["point"][:2])) < 0.01
