"""Cameras and recordings through OpenCV: pace, loss and return, settings, sources by name."""

from __future__ import annotations

import itertools
import re
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from petrobot.services.comm.streams import capture
from petrobot.services.comm.streams.camera import StreamImages, open_images
from petrobot.services.comm.streams.capture import (
    CaptureImages,
    CaptureSettings,
    RecordedImages,
    grey,
    settings_of,
)
from petrobot.services.comm.streams.image import Image, ImageSource
from tests.ports import free_ports
from tests.waiting import Limit, wait_for

SIZE = (48, 64)
GREY = np.full((*SIZE, 3), 90, np.uint8)


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a video of ten images, each brighter than the one before."""
    path = tmp_path_factory.mktemp("film") / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, SIZE[::-1])
    assert writer.isOpened()
    for k in range(10):
        writer.write(np.full((*SIZE, 3), 20 * k, np.uint8))
    writer.release()
    return path


def test_a_file_is_paced_by_the_clock(film: Path) -> None:
    clock = [100.0]
    images: ImageSource = RecordedImages(str(film), lambda: clock[0])
    assert images.newest() is None
    for _ in range(2):  # A second start begins from the first image again.
        images.start(25.0)
        assert images.condition == ""
        begin = clock[0]
        first = images.newest()
        assert first is not None and (first.sequence, first.time) == (0, begin)
        assert images.newest() is None
        clock[0] += 0.121
        later = images.newest()
        assert later is not None and later.sequence == 3
        assert later.time == pytest.approx(begin + 0.12)
        assert later.pixels.shape == SIZE and abs(float(later.pixels.mean()) - 60) < 6
        clock[0] += 5.0
        assert images.newest() is not None, "the last one"
        assert images.newest() is None, "the video has ended"
        assert images.condition == f"recording {str(film)!r} is over"
    images.stop()
    assert images.newest() is None
    images.close()


def test_a_file_in_colour(film: Path) -> None:
    images = open_images({"source": f"file:{film}", "colour": True}, time.monotonic)
    images.start(25.0)
    image = images.newest()
    assert image is not None and image.pixels.shape == (*SIZE, 3)
    images.close()


def test_a_recording_that_cannot_be_opened_is_reported(tmp_path: Path) -> None:
    images = RecordedImages(str(tmp_path / "none.avi"), time.monotonic)
    with pytest.raises(ConnectionError, match=r"none\.avi.*cannot be opened"):
        images.start(25.0)


class Device:
    """Stands for cv2.VideoCapture: gives an image each 2 ms while it is not `absent`."""

    opened: list[Any]
    accepted: dict[int, float]
    absent = False
    channels = 3

    def __init__(self, *how: Any) -> None:
        self.opened.append(how)

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        return not self.absent

    def set(self, key: int, value: float) -> bool:
        self.accepted[key] = value
        return True

    def grab(self) -> bool:
        threading.Event().wait(0.002)
        return not self.absent

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.full((*SIZE, self.channels), (0, 100, 0)[: self.channels], np.uint8)

    def release(self) -> None:
        self.opened.append("released")


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> type[Device]:
    """A device of this test's own in place of OpenCV's; a lost one is opened again at once."""

    class Own(Device):
        opened: list[Any] = []  # noqa: RUF012 - shared by all that are opened
        accepted: dict[int, float] = {}  # noqa: RUF012

    monkeypatch.setattr(cv2, "VideoCapture", Own)
    monkeypatch.setattr(capture, "FIRST_WAIT", 0.01)
    return Own


def test_images_of_a_camera_are_stamped_on_arrival(device: type[Device]) -> None:
    """Only the newest is kept, with the time of its arrival less the latency."""
    images = CaptureImages(2, lambda: 7.0, CaptureSettings(latency=0.03))
    images.start(30.0)
    image = wait_for(images.newest, awaited="an image")
    assert image.time == pytest.approx(6.97)
    assert image.pixels.shape == SIZE
    assert image.pixels[0, 0] == 59, "green by ITU-R BT.601"
    images.close()
    assert device.opened[0] == (2,) and device.opened[-1] == "released"
    assert device.accepted == {cv2.CAP_PROP_FPS: 30.0}


def test_a_lost_camera_is_opened_again(
    device: type[Device], caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    """While it is away `condition` and `start` say so. It may come back as another device file."""
    path = tmp_path / "eye"
    path.symlink_to("/dev/null")
    images = CaptureImages(str(path), time.monotonic, CaptureSettings(colour=True))
    images.start(30.0)
    first: Image = wait_for(images.newest, awaited="an image")
    assert first.pixels.shape == (*SIZE, 3)
    path.unlink()
    device.absent = True
    wait_for(lambda: "cannot be opened" in images.condition, awaited="the loss")
    with pytest.raises(ConnectionError, match=r"eye' cannot be opened: is it plugged in, .* no /"):
        images.start(30.0)
    path.symlink_to("/dev/zero")
    device.absent = False
    wait_for(lambda: not images.condition, awaited="the return")
    later: Image = wait_for(images.newest, awaited="an image after the return")
    assert later.time > first.time
    images.close()
    assert "eye' was lost; it is opened again in" in caplog.text
    opened = [how for how in device.opened if how != "released"]
    assert opened[0][0] == "/dev/null" and opened[-1][0] == "/dev/zero"
    assert device.opened.count("released") == len(device.opened) / 2


def test_an_image_that_cannot_be_converted_is_no_end(device: type[Device]) -> None:
    """As of a camera that gives YUYV: its two channels are no colours."""
    device.channels = 2
    images = CaptureImages(0, time.monotonic)
    with pytest.raises(ConnectionError, match="camera 0: no usable image, try another fourcc"):
        images.start(30.0)
    wait_for(lambda: device.opened.count("released") == 2, awaited="the second attempt")
    assert "no usable image" in images.condition, "said until an image came"
    device.channels = 3
    wait_for(images.newest, awaited="an image")
    images.close()


@pytest.mark.parametrize(
    ("pixels", "table", "text"),
    [
        (np.zeros((4, 6), np.uint16), {}, "expected 8 bits .*, found uint16"),
        (np.zeros((4, 6, 3), np.float32), {"colour": True}, "expected 8 bits .*, found float32"),
        (np.zeros((4, 6), np.uint8), {"colour": True}, r"expected colours, .*remove colour = true"),
        (np.zeros((4, 6, 4), np.uint8), {"colour": True}, r"expected colours, found \(4, 6, 4\)"),
        (np.zeros((4, 6), np.uint8), {}, ""),
        (np.zeros((4, 6, 1), np.uint8), {}, ""),
        (np.zeros((4, 6, 4), np.uint8), {}, ""),
    ],
)
def test_images_of_other_kinds(
    device: type[Device], pixels: np.ndarray, table: dict[str, Any], text: str
) -> None:
    device.retrieve = lambda self: (True, pixels)  # type: ignore[method-assign]
    images = open_images({"source": "capture:0", **table}, time.monotonic)
    if text:
        with pytest.raises(ConnectionError, match=text):
            images.start(30.0)
    else:
        images.start(30.0)
        assert wait_for(images.newest, awaited="an image").pixels.shape == (4, 6)
    images.close()


def test_another_size_than_it_was_asked_for(
    device: type[Device], caplog: pytest.LogCaptureFixture
) -> None:
    """OpenCV reports that the camera has accepted the size."""
    images = open_images({"source": "capture:0", "width": 1920}, time.monotonic)
    images.start(30.0)
    wait_for(images.newest, awaited="an image")
    images.close()
    high, wide = SIZE
    text = f"camera 0 was asked for images of 1920x{high} and gives {wide}x{high}"
    assert caplog.text.count(text) == 1


def test_a_camera_that_blocks(device: type[Device]) -> None:
    """V4L2 lets a read wait for 10 s. Meanwhile the reason is said; after a close and a start one
    thread alone has the camera."""
    inside, block, now = threading.Event(), threading.Event(), [0.0]
    images = CaptureImages(0, lambda: now[0])
    grab = device.grab

    def blocking(self: Device) -> bool:
        if now[0] and not inside.is_set():
            inside.set()
            block.wait(60.0)
        return grab(self)

    device.grab = blocking  # type: ignore[method-assign]
    images.start(30.0)
    wait_for(images.newest, awaited="an image")
    now[0] = 4.0
    assert inside.wait(60.0)
    now[0] = 9.0
    assert re.fullmatch("camera 0 has given no image for [59] s", images.condition)
    images.close()
    images.start(30.0)
    wait_for(images.newest, awaited="an image of the second opening")
    assert not images.condition
    block.set()
    wait_for(lambda: "released" in device.opened, awaited="the end of the first")
    images.close()
    assert device.opened.count("released") == 2 and len(device.opened) == 4


def test_why_a_camera_of_this_host_cannot_be_opened(device: type[Device], tmp_path: Path) -> None:
    device.absent = True
    (tmp_path / "balls.avi").write_bytes(b"")
    for target, text in {
        "/dev/null": "does another program or device use it",
        "/dev/nothing": "There is no /dev/nothing",
        str(tmp_path / "balls.avi"): 'of a recording write "file:',
        "rtspsrc location=x user-id=ana user-pw=secret ! appsink": "is the pipeline right",
    }.items():
        images = open_images({"source": f"capture:{target}"}, time.monotonic)
        with pytest.raises(ConnectionError, match=text) as raised:
            images.start(30.0)
        images.close()
        assert "secret" not in str(raised.value)


def test_images_that_nobody_wants_are_taken_and_dropped(device: type[Device]) -> None:
    """So the first image after a start is not an old one from the camera's buffer."""
    images = CaptureImages(0, time.monotonic)
    images.start(30.0)
    wait_for(images.newest, awaited="an image")
    images.stop()
    assert images.newest() is None
    began = time.monotonic()
    images.start(30.0)
    assert wait_for(images.newest, awaited="an image").time >= began
    images.close()


def test_an_image_that_was_taken_before_the_start_is_dropped(device: type[Device]) -> None:
    """It was still being converted when somebody else wanted images from now on."""
    clock = itertools.count()
    images = CaptureImages(0, lambda: float(next(clock)))
    calls = itertools.count()
    again: list[float] = []
    retrieve = device.retrieve

    def meanwhile(self: Device) -> tuple[bool, np.ndarray]:
        if next(calls) == 1:
            images.stop()
            again.append(float(next(clock)))
            images.start(30.0)
        return retrieve(self)

    device.retrieve = meanwhile  # type: ignore[method-assign]
    images.start(30.0)
    wait_for(lambda: again, awaited="the second start")
    image: Image = wait_for(images.newest, awaited="an image")
    assert image.time > again[0]
    images.close()


def test_what_a_camera_is_asked_for(device: type[Device]) -> None:
    table = {"fps": 60, "width": 1280, "height": 720, "fourcc": "MJPG", "exposure": 50}
    images = open_images({"source": "capture:/dev/null", **table}, time.monotonic)
    images.start(30.0)
    images.close()
    assert device.opened[0] == ("/dev/null", cv2.CAP_V4L2)
    assert device.accepted == {
        cv2.CAP_PROP_FOURCC: cv2.VideoWriter.fourcc(*"MJPG"),
        cv2.CAP_PROP_FRAME_WIDTH: 1280.0,
        cv2.CAP_PROP_FRAME_HEIGHT: 720.0,
        cv2.CAP_PROP_FPS: 60.0,
        cv2.CAP_PROP_AUTO_EXPOSURE: 1.0,
        cv2.CAP_PROP_EXPOSURE: 50.0,
    }


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ({"width": 64.5}, "width: expected a whole number from 0 to 16384, got 64.5"),
        ({"fps": "fast"}, "fps: expected a number from 0 to 1000, got 'fast'"),
        ({"fps": True}, "fps: expected a number"),
        ({"latency": -1}, "latency: expected a number from 0 to 10, got -1"),
        ({"fourcc": "MJPEG"}, "fourcc: expected four characters"),
        ({"colour": "yes"}, "colour: expected true or false"),
    ],
)
def test_bad_settings_are_refused_with_a_remedy(table: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        settings_of(table)


# --- a network camera -------------------------------------------------------------------------


class Stream(BaseHTTPRequestHandler):
    """A camera that sends JPEGs over HTTP, one after the other, until it is cut in the middle of
    one."""

    cut: threading.Event
    pixels: NDArray[np.uint8]

    def do_GET(self) -> None:
        _, jpeg = cv2.imencode(".jpg", self.pixels)
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=image")
        self.end_headers()
        head = f"--image\r\nContent-Type: image/jpeg\r\nContent-Length: {jpeg.size}\r\n\r\n"
        try:
            limit = Limit("the end of the test")
            while not self.cut.wait(0.02) and limit.left():
                self.wfile.write(head.encode() + jpeg.tobytes() + b"\r\n")
            self.wfile.write(head.encode() + jpeg.tobytes()[: jpeg.size * 2 // 3])
        except OSError:
            pass

    def log_message(self, *said: Any) -> None:
        """Say nothing."""


class Network:
    """A camera in the network that can be cut off and come back at the same address."""

    def __init__(self) -> None:
        [self.port] = free_ports(1)
        self.plug()

    def plug(self, pixels: NDArray[np.uint8] = GREY) -> None:
        """Let it come (back), with this image."""
        self._cut = threading.Event()
        handler = type("Own", (Stream,), {"cut": self._cut, "pixels": pixels})
        self._server = ThreadingHTTPServer(("127.0.0.1", self.port), handler)
        self._serving = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._serving.start()

    def unplug(self) -> None:
        """Cut it off: its connections end, and nobody listens."""
        self._cut.set()
        self._server.shutdown()
        self._server.server_close()
        self._serving.join()


@pytest.fixture
def network() -> Iterator[Network]:
    camera = Network()
    yield camera
    camera.unplug()


def test_a_network_camera_is_cut_off_and_comes_back(network: Network) -> None:
    """With OpenCV's own reader of network streams."""
    url = f"http://127.0.0.1:{network.port}/video"
    images = open_images({"source": f"capture:{url}"}, time.monotonic)
    images.start(25.0)
    image = wait_for(images.newest, awaited="an image")
    assert image.pixels.shape == SIZE and abs(float(image.pixels.mean()) - 90) < 3
    network.unplug()
    wait_for(lambda: images.condition, awaited="the loss")
    assert url in images.condition
    network.plug()
    wait_for(lambda: not images.condition, awaited="the return")
    images.start(25.0)
    assert wait_for(images.newest, awaited="an image again").pixels.shape == SIZE
    images.close()


def test_no_part_of_a_cut_image_is_delivered_and_another_size_may_come_back() -> None:
    """The lower third of the last image is missing: a decoder would fill it with grey."""
    noise = np.random.default_rng(1).integers(0, 40, (240, 320, 1), np.uint8)
    bright = np.repeat(noise + 200, 3, axis=2).astype(np.uint8)
    camera = Network()
    camera.unplug()
    camera.plug(bright)
    images = CaptureImages(f"http://127.0.0.1:{camera.port}/", time.monotonic)
    taken = list[NDArray[np.uint8]]()

    def more(shape: tuple[int, int]) -> bool:
        if (newest := images.newest()) is not None:
            taken.append(newest.pixels)
        return bool(taken) and taken[-1].shape == shape

    try:
        images.start(0.0)
        images.start(25.0)
        wait_for(lambda: more((240, 320)), awaited="the first image")
        camera.unplug()
        wait_for(lambda: more((0, 0)) or "was lost" in images.condition, awaited="the loss")
        camera.plug(bright[:120])
        wait_for(lambda: more((120, 320)), awaited="smaller images")
        assert images.condition == ""
        assert {each.shape for each in taken} == {(240, 320), (120, 320)}
        assert all(each[-20:].mean() > 195 for each in taken)
    finally:
        images.close()
        camera.unplug()


def test_a_network_camera_that_is_not_there_is_reported(network: Network) -> None:
    network.unplug()
    images = open_images({"source": f"capture:http://127.0.0.1:{network.port}/"}, time.monotonic)
    with pytest.raises(ConnectionError, match="cannot be opened: is it plugged in"):
        images.start(25.0)
    images.close()
    network.plug()


def test_a_password_is_not_shown(network: Network, caplog: pytest.LogCaptureFixture) -> None:
    network.unplug()
    address = f"127.0.0.1:{network.port}/video"
    images = open_images({"source": f"capture:http://ana:se@cret@{address}"}, time.monotonic)
    with pytest.raises(ConnectionError, match=f"'http://{address}'.*USER:PASSWORD") as raised:
        images.start(25.0)
    images.close()
    assert "cret" not in str(raised.value) + images.condition + caplog.text
    network.plug()


# --- sources by name --------------------------------------------------------------------------


class Own:
    """A vendor's camera in a module of the user's."""

    condition = ""

    def __init__(self, config: dict[str, Any], clock: Callable[[], float]) -> None:
        self._clock, self._level = clock, int(config.get("level", 7))

    def start(self, rate: float) -> None:
        """It is always on."""

    def stop(self) -> None:
        """It stays on."""

    def close(self) -> None:
        """Nothing to release."""

    def newest(self) -> Image:
        """One level everywhere."""
        return Image(np.full(SIZE, self._level, np.uint8), self._clock(), 0)


def test_grey_levels_of_a_grey_image_are_its_own() -> None:
    level = np.arange(12, dtype=np.uint8).reshape(3, 4)
    assert grey(level) is level


@pytest.mark.parametrize(
    ("config", "kind"),
    [
        ({"source": "sim", "address": "127.0.0.1:4810"}, StreamImages),
        ({"source": "capture:0", "latency": 0.03}, CaptureImages),
        ({"source": "capture:/dev/v4l/by-id/usb-A"}, CaptureImages),
        ({"source": "capture:rtsp://10.0.0.5/stream"}, CaptureImages),
        ({"source": "capture:videotestsrc ! appsink"}, CaptureImages),
        ({"source": "file:balls.avi"}, RecordedImages),
        ({"source": "tests.comm.test_capture:Own"}, Own),
    ],
)
def test_sources_by_config(config: dict[str, object], kind: type) -> None:
    assert isinstance(open_images(config, time.monotonic), kind)


class Foreign(Own):
    """It lacks what a source needs."""

    newest = None  # type: ignore[assignment]

    def condition(self) -> str:  # type: ignore[override]
        return ""


@pytest.mark.parametrize(
    ("config", "text"),
    [
        ({}, "source = ''"),
        ({"source": "tests.comm.test_capture:Foreign"}, r"has no newest, condition \(a text"),
        ({"source": "sim"}, "needs address"),
        ({"source": "sim", "address": "host"}, "needs address"),
        ({"source": "capture:front"}, 'use "sim", "capture:0"'),
        ({"source": "nowhere.cams:Basler"}, "No module named 'nowhere'"),
        ({"source": "tests.comm.test_capture:Basler"}, "no attribute 'Basler'"),
        ({"source": "file:"}, 'use "sim"'),
        ({"source": "rtsp://ana:secret@10.0.0.5/"}, r"source = 'rtsp://10\.0\.0\.5/'"),
    ],
)
def test_bad_sources_are_refused_with_a_remedy(config: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        open_images(config, time.monotonic)
