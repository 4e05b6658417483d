"""Tracking: follows a located ball in a small window of each image and streams where and when it
will leave the table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from petrobot.services.action import Cancelled, Context, Result, error, failure, success
from petrobot.services.camera import CameraError
from petrobot.services.comm.streams.image import Image
from petrobot.services.vision.camera import Camera, Mark
from petrobot.services.vision.location import BallWindow
from petrobot.services.vision.prediction import ExitWay, PredictedExit, Predictor, Surface
from petrobot.services.vision.specification import Specification

HIDDEN = 0.20
"""Distance before the near edge in which arm and cup may hide the ball (m)."""
SPREAD_PX = 5.0
"""Radius around the expected place in which the ball is searched (px)."""
GROWTH_PX = 4.0
"""Growth of that radius with each image in which the ball was not seen (px)."""
OTHERWISE = 5
"""Images in a row that predict another exit than over the near edge, after which the ball is given
up."""
LEAST_SIGHTS = 5
"""Sights of a ball that must have been there."""
JUDGED_SPAN = 0.15
"""s of sights from which it is measured where the ball left, and where it was when located."""

Predictions = Sequence[tuple[float, float, float]]
"""When each was made, and when (s) and where (y, m) the ball will leave by it."""


class TrackSpecification(Specification, frozen=True):
    """When a tracked ball was predicted well enough, and when it is lost (s, m)."""

    rate: float = 0.0
    """Images/s; 0: the camera's usual rate."""
    image_timeout: float = 0.5
    """Time without an image after which the camera counts as dead (s)."""
    contrast: float = BallWindow.CONTRAST
    """Grey levels by which a ball must be brighter than the table."""
    lost_after: float = 0.20
    """Time without a sight of a ball that should be in plain view (s)."""
    lead: float = 0.45
    """Time before the ball leaves from which on predictions are judged (s)."""
    place_within: float = 0.0
    """m along the near edge that they may be off where the last sights show that the ball left,
    else FAILURE `off`. 0: they are compared with the last prediction."""
    time_within: float = 0.0
    """s that they may be off when it left, else FAILURE `off`; given with `place_within`."""
    max_time_spread: float = 0.010
    """Greatest difference in time from the last prediction (s), else FAILURE `unsteady`."""
    max_place_spread: float = 0.008
    """The same along the near edge (m)."""

    def __post_init__(self) -> None:
        """Raise ValueError if only one of the two limits is given."""
        if (self.place_within > 0.0) != (self.time_within > 0.0):
            raise ValueError("give both place_within (m) and time_within (s), or neither")

    @property
    def measures(self) -> bool:
        """Whether predictions are judged by where and when the ball was seen to leave."""
        return self.place_within > 0.0


async def track(
    ctx: Context,
    make: Callable[[Surface], Predictor],
    ball: Mapping[str, Any],
    stream: str,
    specification: TrackSpecification,
) -> Result:
    """Track `ball` (as a locator returned it) with the predictor that `make` makes, and give the
    verdict on the locator's run if it is to be judged; the images end with the run."""
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
    if result.cause not in ("no_image", "bad_image"):
        chase.judge_locator(ball)
    if result.cause not in ("", "unsteady", "off", "late"):
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
        self._window = BallWindow(camera.view, specification.contrast)
        self._exit: PredictedExit | None = None
        self._made: list[tuple[float, float, float]] = []
        self._sights: list[tuple[float, float, float]] = []
        """Time (s) and place (m) of each sight."""
        self._latencies: list[float] = []
        """Time from the middle of an exposure to its set point (s)."""
        self._images = self._seen = self._misses = self._otherwise = 0
        self._seen_at = 0.0
        self._located = (0.0, 0.0, 0.0)
        """Time (s) and last place (m) as located."""

    def begin(self, ball: Mapping[str, Any]) -> None:
        """Take the located places. Raises KeyError, TypeError or ValueError when they are
        malformed."""
        time = self._camera.time_of(int(ball["sequence"]))
        if time is None:
            time = self._ctx.now - float(ball["age"])
        sigma = max(float(ball["sigma"]), 1e-4)
        for ago, x, y in ball["places"]:
            self._located = (time + float(ago), float(x), float(y))
            self._predictor.add(*self._located, sigma)
        if self._predictor.count < 2:
            raise ValueError("fewer than two places")
        self._seen_at = time
        self._exit = self._predictor.exit()

    async def run(self) -> Result:
        """Read images until the ball has left, is lost, or leaves another way."""
        asked = self._specification
        self._camera.start(asked.rate)
        pause = 1.5 / self._camera.requested
        silent = self._ctx.now
        while True:
            image = await self._camera.read(self._ctx, pause)
            if image is not None:
                silent = self._ctx.now
                ended = self._look(image)
                if ended is not None:
                    return ended
            elif self._ctx.now >= silent + asked.image_timeout:
                text = self._camera.missing(f"no image for {asked.image_timeout} s")
                return error("no_image", text, **self._values())
            if self._left():
                return await self._judged()
            self._publish()

    async def _judged(self) -> Result:
        """Judge the predictions, now that the ball has left."""
        asked, made = self._specification, tuple(self._made)
        if not made:
            return failure("late", "the ball left before it was predicted", **self._values())
        if not asked.measures:
            return self._judge(made, *made[-1][1:], "unsteady", self._values())
        await self._see_it_leave()
        crossing = self._crossing()
        if crossing is None:
            text = f"the ball was seen {len(self._sights)} times, too few to say where it left"
            return failure("unseen", text, **self._values())
        left, y = crossing
        values = {**self._values(), "left": {"ago": self._ctx.now - left, "y": y}}
        return self._judge(made, left, y, "off", values)

    async def _see_it_leave(self) -> None:
        """Read the images that are still on their way when the ball has left."""
        self._ctx.withdraw(self._stream)  # What follows is too late for the arm.
        until = self._ctx.now + self._specification.image_timeout
        while self._exit is not None and self._ctx.now < until:
            image = await self._camera.read(self._ctx, until - self._ctx.now)
            if image is None or image.time > self._exit.time:
                break
            if self._look(image) is not None:
                break

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
        x, y = view.to_table(seen)
        self._predictor.add(image.time, float(x), float(y))
        self._sights.append((image.time, float(x), float(y)))
        self._seen, self._misses, self._seen_at = self._seen + 1, 0, image.time
        ended = self._predicted(image.time)
        self._mark((seen,), (float(x), float(y)))
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

    def judge_locator(self, ball: Mapping[str, Any]) -> None:
        """Give the verdict on the run that located the ball, if it asked for one: was a ball there,
        and as near to its last place as `within` (m)?"""
        run, within = ball.get("run"), ball.get("within")
        if not run or within is None:
            return
        seen = len(self._sights)
        if seen < LEAST_SIGHTS:
            text = f"a ball that rolls from there was seen {seen} times, not {LEAST_SIGHTS}"
            self._ctx.verdict(run, failure("not_there", text))
            return
        time, *place = self._located
        first = np.array([s for s in self._sights if s[0] <= self._sights[0][0] + JUDGED_SPAN])
        if len(first) < LEAST_SIGHTS:
            first = np.array(self._sights[:LEAST_SIGHTS])
        # Of second order, because the ball may still slide: that slows it by 2 m/s^2.
        fit = np.polynomial.polynomial.polyfit(first[:, 0] - time, first[:, 1:], 2)
        off = float(np.hypot(*(fit[0] - place)))
        if off > within:
            text = f"located {off * 1e3:.1f} mm beside the ball's path, not {within * 1e3:.1f} mm"
            self._ctx.verdict(run, failure("inaccurate", text))
        else:
            self._ctx.verdict(run, success())

    def _crossing(self) -> tuple[float, float] | None:
        """Return when (s) and where (y, m) the last sights show that the ball left over the near
        edge; None if there are too few."""
        if len(self._sights) < LEAST_SIGHTS:
            return None
        rows = np.array([s for s in self._sights if s[0] >= self._sights[-1][0] - JUDGED_SPAN])
        if len(rows) < LEAST_SIGHTS:
            rows = np.array(self._sights[-LEAST_SIGHTS:])
        surface, end = self._camera.surface, self._sights[-1][0]
        t = rows[:, 0] - end
        (x0, y0), (vx, vy) = np.polynomial.polynomial.polyfit(t, rows[:, 1:], 1)
        if vx >= 0.0:
            return None
        # The way from the last sight at a speed that rolling lowers: hidden, slow balls need it.
        speed = float(np.hypot(vx, vy))
        way = (surface.near_edge - x0) / vx * speed
        left = speed**2 - 2.0 * surface.rolling * way
        if left <= 0.0:
            return None
        after = (speed - float(np.sqrt(left))) / surface.rolling if way > 0.0 else way / speed
        return end + after, float(y0 + vy / speed * way)

    def _judge(
        self, made: Predictions, left: float, place: float, cause: str, values: dict[str, Any]
    ) -> Result:
        """Compare the predictions of the last moments with when (s) and where (y, m) the ball
        left."""
        asked = self._specification
        first = made[0][0]
        if first > left - asked.lead:
            text = f"first prediction {left - first:.2f} s before the ball left, not {asked.lead} s"
            return failure("late", text, **values)
        # The prediction in force at the lead time, and all later ones.
        begin = max(at for at, _, _ in made if at <= left - asked.lead)
        judged = [(time, y) for at, time, y in made if at >= begin]
        time_off = max(abs(time - left) for time, _ in judged)
        place_off = max(abs(y - place) for _, y in judged)
        values |= {"time_spread": time_off, "place_spread": place_off}
        most_time = asked.time_within or asked.max_time_spread
        most_place = asked.place_within or asked.max_place_spread
        if time_off > most_time or place_off > most_place:
            what = "were off" if cause == "off" else "moved"
            text = f"predictions {what} by {time_off * 1e3:.0f} ms and {place_off * 1e3:.0f} mm"
            return failure(cause, text, **values)
        return success(**values)

    def _values(self) -> dict[str, Any]:
        """Return the values of every result."""
        values: dict[str, Any] = {"images": self._images, "seen": self._seen}
        if self._specification.measures:
            values["count"] = self._images  # what the run used, for its cost
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
