"""The rover's file of numbers: read whole, and refused with file, key and remedy."""

from __future__ import annotations

from importlib.resources import files

import pytest

from petrobot.services.mobile.model import RoverFileError, nominal_rover, read_rover

TEXT = files("petrobot.services.mobile").joinpath("rover.toml").read_text(encoding="utf-8")


def test_the_shipped_file_is_read() -> None:
    rover = nominal_rover()
    assert (rover.track.square, rover.track.width) == (2.0, 0.05)
    assert rover.camera.principal_px == (79.5, 59.5)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("wheel_radius = 0.10", "wheel_radius = -0.10", "[rover] wheel_radius"),
        ("focal_px = 140.0", 'focal_px = "wide"', "[camera] focal_px"),
        ("principal_px = [79.5, 59.5]", "principal_px = [79.5]", "[camera] principal_px"),
        ("[track]", "[trak]", "[track]"),
        ("[track]", "[track", "not valid TOML"),
    ],
)
def test_a_bad_one_is_refused_with_file_and_key(old: str, new: str, named: str) -> None:
    assert old in TEXT
    with pytest.raises(RoverFileError) as refused:
        read_rover(TEXT.replace(old, new, 1), "mine.toml")
    assert "mine.toml" in str(refused.value) and named in str(refused.value)
