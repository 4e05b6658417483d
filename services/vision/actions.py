"""Primitive actions of the camera: locate a rolling ball in five ways; track it and predict in
three ways where it leaves the table.

Every locator returns `ball`, plain data from which every tracker starts: `places`, rows [dt, x, y]
(s relative to the image `sequence`, m, base frame), their accuracy `sigma` (m), and the `age` (s)
of that image when the locator finished.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from petrobot.services.action import Context, Result
from petrobot.services.vision.camera import Camera
from petrobot.services.vision.locating import LocateSpecification, locate
from petrobot.services.vision.location import (
    BackgroundSubtraction,
    BallDetector,
    CompensatedSubtraction,
    FixedThreshold,
    HoughCircles,
    MixtureOfGaussians,
)
from petrobot.services.vision.prediction import (
    ConstantVelocity,
    Kalman,
    LeastSquares,
    Predictor,
    Surface,
)
from petrobot.services.vision.tracking import TrackSpecification, track


def _background(camera: Camera) -> BallDetector:
    return BackgroundSubtraction(camera.view, camera.background)


def _compensated(camera: Camera) -> BallDetector:
    return CompensatedSubtraction(camera.view, camera.background)


def _mog2(camera: Camera) -> BallDetector:
    return MixtureOfGaussians(camera.view)


def _hough(camera: Camera) -> BallDetector:
    return HoughCircles(camera.view)


def _threshold(camera: Camera) -> BallDetector:
    return FixedThreshold(camera.view)


async def locate_background(ctx: Context, **options: float) -> Result:
    """Locate a rolling ball by subtracting the stored picture of the empty table: accurate and
    cheap in steady light.

    Options: those of `LocateSpecification`. SUCCESS and FAILURE (cause `inaccurate` or `late`)
    return `ball` and `images`; ERROR has cause `no_ball`, `no_image` or `bad_image`. With `within`,
    SUCCESS is provisional, and the tracker of this ball judges.
    """
    return await locate(ctx, "background", _background, 0.0007, LocateSpecification.of(options))


async def locate_mog2(ctx: Context, **options: float) -> Result:
    """Locate a rolling ball by a mixture-of-Gaussians background (MOG2): follows changing light,
    costs most. Otherwise as `locate_background`."""
    return await locate(ctx, "mog2", _mog2, 0.0022, LocateSpecification.of(options))


async def locate_hough(ctx: Context, **options: float) -> Result:
    """Locate a rolling ball as a moving circle: needs no background, coarse. Otherwise as
    `locate_background`."""
    return await locate(ctx, "hough", _hough, 0.0028, LocateSpecification.of(options))


async def locate_threshold(ctx: Context, **options: float) -> Result:
    """Locate a rolling ball as what is brighter than one grey level: cheapest, fails in uneven or
    dim light. Otherwise as `locate_background`."""
    return await locate(ctx, "threshold", _threshold, 0.0015, LocateSpecification.of(options))


async def locate_compensated(ctx: Context, **options: float) -> Result:
    """Locate a rolling ball by subtracting the stored picture, scaled to the light of each image:
    as accurate as `locate_background`, even where lamps flicker or were switched. Otherwise as
    `locate_background`."""
    return await locate(ctx, "compensated", _compensated, 0.0007, LocateSpecification.of(options))


async def _predict(
    ctx: Context,
    make: Callable[[Surface], Predictor],
    ball: Mapping[str, Any],
    stream: str,
    options: dict[str, float],
) -> Result:
    return await track(ctx, make, ball, stream, TrackSpecification.of(options))


async def predict_least_squares(
    ctx: Context, *, ball: Mapping[str, Any], stream: str = "catch_point", **options: float
) -> Result:
    """Track the ball and stream its predicted exit, by least squares with sliding and rolling
    deceleration.

    Publishes [time_to_go, x, y, z, vx, vy, vz, sigma_y, sigma_t] (s, m, m/s) at each image until
    the ball leaves the table. Options: those of `TrackSpecification`. SUCCESS: the predictions
    were right in time; FAILURE: `off` or `unsteady`, `late`, `unseen`, `side_exit` or `stays`;
    ERROR: `ball_lost`, `no_image`, `bad_image` or `bad_ball`. Values: `exit`, `images`, `seen`, and
    `left`, where and when it was seen to leave.
    """
    return await _predict(ctx, LeastSquares, ball, stream, options)


async def predict_kalman(
    ctx: Context, *, ball: Mapping[str, Any], stream: str = "catch_point", **options: float
) -> Result:
    """Track the ball and stream its predicted exit, by an extended Kalman filter. Otherwise as
    `predict_least_squares`."""
    return await _predict(ctx, Kalman, ball, stream, options)


async def predict_constant_velocity(
    ctx: Context, *, ball: Mapping[str, Any], stream: str = "catch_point", **options: float
) -> Result:
    """Track the ball and stream its predicted exit at constant speed: cheapest, late for slow
    balls. Otherwise as `predict_least_squares`."""
    return await _predict(ctx, ConstantVelocity, ball, stream, options)
