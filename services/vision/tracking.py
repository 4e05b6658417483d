"""Tracking: follows a located ball in a small window of each image and streams where and when it
will leave the table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from petrobot.services.action import Cancelled, Context, Result, error, failure, success
from petrobot.services.comm.streams.image import Image
from petrobot.services.vision.camera import Camera, CameraError, Mark
from petrobot.services.vision.location import BallWindow
from petrobot.services.vision.prediction import ExitWay, PredictedExit, Predictor, Surface
from petrobot.services.vision.specification import Specification

HIDDEN = 0.20
"""m before the near edge in which arm and cup may hide the ball."""
SPREAD_PX = 5.0
"""px around the expected place in which the ball is searched."""
GROWTH_PX = 4.0
"""px by which that grows with each image in which the ball was not seen."""
OTHERWISE = 5
"""Images in a row that predict another exit than over the near edge, after which the ball is given
up."""


@dataclass(frozen=True, slots=True)
class TrackSpecification(Specification):
    """When a tracked ball was predicted well enough, and when it is lost (s, m)."""

    rate: float = 0.0
    """Images/s; 0: the camera's usual rate."""
    image_timeout: float = 0.5
    """s without an image after which the camera counts as dead."""
    lost_after: float = 0.20
    """s without a sight of a ball that should be in plain view."""
    lead: float = 0.45
    """s before the ball leaves; from then on predictions must agree with the last one."""
    max_time_spread: float = 0.010
    """s, else FAILURE `unsteady`."""
    max_place_spread: float = 0.008
    """m along the near edge, else FAILURE `unsteady`."""


async def track(
    ctx: Context,
    make: Callable[[Surface], Predictor],
    ball: Mapping[str, Any],
    stream: str,
    specification: TrackSpecification,
) -> Result:
    """Track `ball` (as a locator returned it) with the predictor that `make` makes; the images end
    with the run."""
    camera: Camera = ctx.device
    chase = _Chase(ctx, camera, make(camera.surface), stream, specification)
    try:
        chase.begin(ball)
    except (KeyError, TypeError, ValueError) as fault:
        camera.end()
        return error("bad_ball", f"the ball to track is no locator's ball: {fault!r}")
    try:
        result = await chase.run()
    except (CameraError, ConnectionError) as fault:
        result = error("bad_image" if isinstance(fault, CameraError) else "no_image", str(fault))
    except Cancelled:
        ctx.withdraw(stream)
        camera.end()
        raise
    if result.cause not in ("", "unsteady", "late"):
        ctx.withdraw(stream)
    camera.end()
    return result


class _Chase:
    """One run of a tracker."""

    def __init__(
        self,
        ctx: Context,
        camera: Camera,
        predictor: Predictor,
        stream: str,
        specification: TrackSpecification,
    ) -> None:
        self._ctx = ctx
        self._camera = camera
        self._predictor = predictor
        self._stream = stream
        self._specification = specification
        self._window = BallWindow(camera.view)
        self._exit: PredictedExit | None = None
        self._made: list[tuple[float, float, float]] = []
        self._latencies: list[float] = []
        """s from the middle of an exposure to the set point that it led to."""
        self._images = self._seen = self._misses = self._otherwise = 0
        self._seen_at = 0.0

    def begin(self, ball: Mapping[str, Any]) -> None:
        """Take the located places. Raises KeyError, TypeError or ValueError when they are
        malformed."""
        time = self._camera.time_of(int(ball["sequence"]))
        if time is None:
            time = self._ctx.now - float(ball["age"])
        sigma = max(float(ball["sigma"]), 1e-4)
        for ago, x, y in ball["places"]:
            self._predictor.add(time + float(ago), float(x), float(y), sigma)
        if self._predictor.count < 2:
            raise ValueError("fewer than two places")
        self._seen_at = time
        self._exit = self._predictor.exit()

    async def run(self) -> Result:
        """Read images until the ball has left, is lost, or leaves another way."""
        asked = self._specification
        self._camera.start(asked.rate)
        pause = 1.5 / self._camera.rate
        silent = self._ctx.now
        while True:
            image = await self._camera.read(self._ctx, pause)
            if image is not None:
                silent = self._ctx.now
                ended = self._look(image)
                if ended is not None:
                    return ended
            elif self._ctx.now >= silent + asked.image_timeout:
                return error("no_image", f"no image for {asked.image_timeout} s", **self._values())
            if self._left():
                return self._judge()
            self._publish()

    def _left(self) -> bool:
        return (
            self._exit is not None
            and self._exit.way is ExitWay.NEAR_EDGE
            and self._exit.time <= self._ctx.now
        )

    def _look(self, image: Image) -> Result | None:
        """Measure the ball where it is expected; return a result when the run finishes with this
        image."""
        self._images += 1
        view, picture = self._camera.view, self._camera.background.picture
        if picture is None:
            self._camera.background.learn(image.pixels)
            return None
        expected = self._predictor.place(image.time)
        ahead = self._predictor.place(image.time + 0.01)
        streak = view.streak_px(float(np.hypot(*(ahead - expected))) / 0.01)
        spread = SPREAD_PX + GROWTH_PX * self._misses
        seen = self._window.measure(image.pixels, picture, view.to_pixels(expected), streak, spread)
        if seen is None:
            return self._missed(image.time, expected)
        x, y = view.to_table(seen.centre)
        self._predictor.add(image.time, float(x), float(y))
        self._seen, self._misses, self._seen_at = self._seen + 1, 0, image.time
        ended = self._predicted(image.time)
        self._mark((seen.centre,), (float(x), float(y)))
        return ended

    def _mark(self, centres: tuple[Any, ...], place: tuple[float, float]) -> None:
        """Show the operator where the ball is seen, and the path to where it is predicted to
        leave."""
        exit_ = self._exit
        ahead = () if exit_ is None else (place, (float(exit_.point[0]), float(exit_.point[1])))
        self._camera.marks = (Mark("ball", pixels=centres), Mark("predicted exit", table=ahead))

    def _missed(self, time: float, expected: Any) -> Result | None:
        self._misses += 1
        self._mark((), (float(expected[0]), float(expected[1])))
        edge = self._camera.view.near_edge
        if (
            float(expected[0]) < edge + HIDDEN
            or time - self._seen_at < self._specification.lost_after
        ):
            return None
        text = (
            f"not seen for {time - self._seen_at:.2f} s, expected at ({expected[0]:.3f}, "
            f"{expected[1]:.3f}) m"
        )
        return error("ball_lost", text, **self._values())

    def _predicted(self, time: float) -> Result | None:
        """Use a fresh prediction; return a result when the ball will certainly not leave over the
        near edge."""
        exit_ = self._predictor.exit()
        if exit_ is None or exit_.way is ExitWay.NEAR_EDGE:
            self._otherwise = 0
            if exit_ is not None:
                self._exit = exit_
                self._made.append((self._ctx.now, exit_.time, float(exit_.point[1])))
                self._latencies.append(self._ctx.now - time)
            return None
        self._otherwise += 1
        if self._otherwise < OTHERWISE:
            return None
        self._exit = exit_
        where = f"({exit_.point[0]:.3f}, {exit_.point[1]:.3f}) m"
        if exit_.way is ExitWay.SIDE:
            return failure("side_exit", f"the ball leaves by the side at {where}", **self._values())
        return failure(
            "stays", f"the ball stops on the table or turns away at {where}", **self._values()
        )

    def _publish(self) -> None:
        """Stream the newest prediction; its time to go is correct now, however old the image
        was."""
        exit_ = self._exit
        if exit_ is None or exit_.way is not ExitWay.NEAR_EDGE:
            return
        view = self._camera.view
        to_go = exit_.time - self._ctx.now
        vx, vy = (float(v) for v in exit_.velocity)
        point = (view.near_edge, float(exit_.point[1]), view.height)
        self._ctx.publish(
            self._stream, [to_go, *point, vx, vy, 0.0, exit_.sigma_place, exit_.sigma_time]
        )

    def _judge(self) -> Result:
        """Compare the predictions of the last moments with the last one: the ball has left."""
        asked = self._specification
        if self._exit is None or not self._made:
            return failure("late", "the ball left before it was predicted", **self._values())
        _, left, place = self._made[-1]
        first = self._made[0][0]
        if first > left - asked.lead:
            text = f"first prediction {left - first:.2f} s before the ball left, not {asked.lead} s"
            return failure("late", text, **self._values())
        # The prediction in force at the lead time, and all later ones.
        begin = max(made for made, _, _ in self._made if made <= left - asked.lead)
        judged = [(time, y) for made, time, y in self._made if made >= begin]
        time_spread = max(abs(time - left) for time, _ in judged)
        place_spread = max(abs(y - place) for _, y in judged)
        values = {**self._values(), "time_spread": time_spread, "place_spread": place_spread}
        if time_spread > asked.max_time_spread or place_spread > asked.max_place_spread:
            text = (
                f"predictions moved by {time_spread * 1e3:.0f} ms and {place_spread * 1e3:.0f} mm"
            )
            return failure("unsteady", text, **values)
        return success(**values)

    def _values(self) -> dict[str, Any]:
        """Return the values of every result."""
        values: dict[str, Any] = {"images": self._images, "seen": self._seen}
        if self._latencies:
            values["latency"] = float(np.mean(self._latencies))
            values["latency_longest"] = max(self._latencies)
        if self._exit is not None and np.isfinite(self._exit.time):
            values["exit"] = {
                "way": str(self._exit.way),
                "in": self._exit.time - self._ctx.now,
                "point": [
                    float(self._exit.point[0]),
                    float(self._exit.point[1]),
                    self._camera.view.height,
                ],
                "velocity": [float(v) for v in self._exit.velocity],
            }
        return values
