"""The arms' geometry: published poses."""

from __future__ import annotations

import math

import pytest

from petrobot.services.adapters.ur.kinematics import chain


@pytest.mark.parametrize(
    ("model", "place"),
    [
        ("ur3e", (-0.45675, -0.22315, 0.0665)),
        ("ur5e", (-0.8172, -0.2329, 0.0628)),
        ("ur10e", (-1.18425, -0.2907, 0.06085)),
    ],
)
def test_stretched_out_the_flange_is_where_the_pendant_shows_it(
    model: str, place: tuple[float, ...]
) -> None:
    """All joints at zero: sums of the lengths (d1 - d5 above, d4 + d6 aside, a2 + a3 out)."""
    pose = chain(model).tool([0.0] * 6)
    assert pose[:3] == pytest.approx(place) and pose[3:] == pytest.approx((math.pi / 2, 0.0, 0.0))
