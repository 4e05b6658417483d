"""Lock step: a value passed on within a process equals what another process would receive."""

from __future__ import annotations

import numpy as np
import pytest

from petrobot.services.comm.lockstep.cell import as_received
from petrobot.services.comm.protocol.plain import NotPlainError, pack_array, unpack_array


def _image() -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.arange(48, dtype=np.uint8).reshape(6, 8)


def test_data_that_its_sender_may_still_write_to_is_copied() -> None:
    image = _image().copy()
    sent = as_received("image", {"pixels": image})["pixels"]
    image[0, 0] = 99
    assert sent[0, 0] == 0
    assert not sent.flags.writeable


def test_a_read_only_image_is_passed_on_without_a_copy() -> None:
    image = _image().copy()
    image.flags.writeable = False
    sent = as_received("image", {"pixels": image})["pixels"]
    assert sent is image
    there = unpack_array(pack_array(image))
    assert np.array_equal(sent, there) and sent.dtype == there.dtype and not there.flags.writeable


def test_a_read_only_view_of_writable_data_is_copied() -> None:
    image = _image().copy()
    window = image[1:4, 2:5]
    window.flags.writeable = False
    sent = as_received("image", {"pixels": window})["pixels"]
    image[:] = 0
    assert sent.tolist() == [[10, 11, 12], [18, 19, 20], [26, 27, 28]]


@pytest.mark.parametrize("array", [np.zeros(3, np.int32), np.zeros((1, 1, 1, 1, 1), np.uint8)])
def test_data_that_no_envelope_carries_is_refused_read_only_or_not(
    array: np.ndarray[tuple[int, ...], np.dtype[np.generic]],
) -> None:
    for locked in (False, True):
        array.flags.writeable = not locked
        with pytest.raises(NotPlainError, match="only uint8 or float64"):
            as_received("image", {"pixels": array})
