"""Images over sockets and from files: any division of the bytes, bad bytes, newest wins, restarts,
missing devices."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, strategies as st

from petrobot.services.comm.streams.camera import (
    IMAGE_HEADER,
    ImageDecoder,
    ImageFormatError,
    ImageServer,
    MemoryImages,
    StreamImages,
    WireImage,
    encode_image,
)
from petrobot.services.comm.streams.image import Image
from tests.ports import free_ports
from tests.waiting import wait_for


def grey(level: int, shape: tuple[int, int] = (48, 64)) -> np.ndarray:
    return np.full(shape, level, np.uint8)


def test_wire_format_byte_by_byte() -> None:
    data = encode_image(WireImage(2, 7, 0.5, np.array([[1, 2, 3], [4, 5, 6]], np.uint8)))
    assert data == bytes.fromhex(
        "50494d47 00000002 0000000000000007 3fe0000000000000 0002 0003 00000006 010203040506"
    )


@given(cuts=st.lists(st.integers(0, 3 * (32 + 12)), max_size=8), take=st.booleans())
def test_any_division_of_the_bytes(cuts: list[int], take: bool) -> None:
    images = [WireImage(1, k, 0.01 * k, np.full((3, 4), k, np.uint8)) for k in range(3)]
    data = b"".join(map(encode_image, images))
    decoder, begin, seen = ImageDecoder(), 0, []
    for end in [*sorted(cuts), len(data)]:
        decoder.feed(data[begin : max(begin, end)])
        begin = max(begin, end)
        newest = decoder.take() if take else None
        if newest is not None:
            seen.append(newest.sequence)
    last = decoder.take()
    if last is not None:
        seen.append(last.sequence)
        assert np.array_equal(last.pixels, images[last.sequence].pixels)
    assert seen == sorted(set(seen)) and seen[-1] == 2
    assert take or seen == [2], "older ones are dropped"


@given(st.binary(max_size=200))
def test_random_bytes_raise_only_format_errors(data: bytes) -> None:
    decoder = ImageDecoder()
    try:
        decoder.feed(data)
    except ImageFormatError:
        return
    assert len(data) < IMAGE_HEADER.size or data.startswith(b"PIMG")


@pytest.mark.parametrize(
    "header",
    [
        IMAGE_HEADER.pack(b"PIMG", 1, 1, 0.1, 4000, 5000, 20_000_000),
        IMAGE_HEADER.pack(b"PIMG", 1, 1, 0.1, 4, 5, 21),
        IMAGE_HEADER.pack(b"PIMG", 1, 1, -1.0, 4, 5, 20),
        IMAGE_HEADER.pack(b"PIMG", 1, 1, float("nan"), 4, 5, 20),
        IMAGE_HEADER.pack(b"JPEG", 1, 1, 0.1, 4, 5, 20),
    ],
)
def test_impossible_headers_are_refused(header: bytes) -> None:
    with pytest.raises(ImageFormatError):
        ImageDecoder().feed(header)


@pytest.fixture
def server() -> Iterator[ImageServer]:
    camera = ImageServer("127.0.0.1", 0)
    yield camera
    camera.close()


@pytest.fixture
def receiver(server: ImageServer) -> Iterator[StreamImages]:
    images = StreamImages("127.0.0.1", server.port, time.monotonic)
    yield images
    images.close()


def test_images_arrive_at_the_requested_rate_and_stop(
    server: ImageServer, receiver: StreamImages
) -> None:
    receiver.start(40.0)
    wait_for(lambda: server.rate == 40.0, server.poll, receiver.newest)
    exposed = time.monotonic() - 0.125
    server.send(grey(9), 0.125)
    image = wait_for(receiver.newest, server.poll)
    assert isinstance(image, Image)
    assert np.array_equal(image.pixels, grey(9))
    assert exposed <= image.time <= time.monotonic() - 0.125
    assert receiver.newest() is None
    receiver.stop()
    wait_for(lambda: server.rate == 0.0, server.poll)
    server.send(grey(1), 0.0)
    assert receiver.newest() is None


def test_newest_wins_and_no_one_waits_for_a_slow_receiver(
    server: ImageServer, receiver: StreamImages
) -> None:
    """A receiver that does not read misses images; the camera continues at once and memory does not
    grow."""
    receiver.start(50.0)
    wait_for(lambda: server.rate > 0.0, server.poll, receiver.newest)
    big = grey(0, (480, 640))
    for k in range(200):
        server.send(big + np.uint8(k), 0.0)
    seen = []

    def read() -> bool:
        image = receiver.newest()
        if image is not None:
            seen.append(image)
        return len(seen) > 0 and seen[-1].sequence >= 200

    def send() -> None:
        server.poll()
        server.send(big, 0.0)

    wait_for(read, send)
    assert len(seen) < 100, "not all of what was missed"
    assert [image.sequence for image in seen] == sorted({image.sequence for image in seen})


def test_images_of_an_earlier_start_are_dropped(
    server: ImageServer, receiver: StreamImages
) -> None:
    receiver.start(50.0)
    wait_for(lambda: server.rate > 0.0, server.poll, receiver.newest)
    server.send(grey(1), 0.0)
    receiver.stop()
    receiver.start(25.0)
    wait_for(lambda: server.rate == 25.0, server.poll, receiver.newest)
    server.send(grey(2), 0.0)
    image = wait_for(receiver.newest, server.poll)
    assert isinstance(image, Image) and image.pixels[0, 0] == 2


def test_a_camera_that_goes_away_is_found_again() -> None:
    clock = [0.0]
    (port,) = free_ports(1)
    first = ImageServer("127.0.0.1", port)
    receiver = StreamImages("127.0.0.1", port, lambda: clock[0])
    receiver.start(50.0)
    wait_for(lambda: first.rate > 0.0, first.poll, receiver.newest)
    first.close()
    wait_for(lambda: receiver._socket is None, receiver.newest)
    assert receiver.newest() is None
    second = ImageServer("127.0.0.1", port)
    clock[0] += 1.0
    wait_for(lambda: second.rate == 50.0, second.poll, receiver.newest)
    second.send(grey(5), 0.0)
    assert wait_for(receiver.newest, second.poll)
    receiver.close()
    second.close()


def test_the_server_disconnects_clients_that_send_malformed_bytes(server: ImageServer) -> None:
    import socket

    with socket.create_connection(("127.0.0.1", server.port)) as stranger:
        stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")
        stranger.setblocking(False)

        def gone() -> bool:
            try:
                return stranger.recv(1) == b""
            except BlockingIOError:
                return False
            except ConnectionError:
                return True

        wait_for(gone, server.poll)
    assert server.rate == 0.0


def test_memory_images() -> None:
    rates: list[float] = []
    images = MemoryImages(rates.append)
    images.put(Image(grey(1), 0.0, 0))
    assert images.newest() is None, "not wanted yet"
    images.start(50.0)
    for k in range(3):
        images.put(Image(grey(k), 0.02 * k, k))
    newest = images.newest()
    assert newest is not None and newest.sequence == 2
    assert images.newest() is None
    images.put(Image(grey(9), 1.0, 9))
    images.close()
    assert images.newest() is None
    assert rates == [50.0, 0.0]
