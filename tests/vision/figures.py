"""Make the annotated camera image and the tables of docs/vision.md. Run it as `python -m
tests.vision.figures`.

With `--tables` it prints the tables (a minute or two), with `--picture` it writes
docs/pictures/camera.png.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Coroutine
from typing import Any

import cv2
import numpy as np
from msgspec import Struct, field

from petrobot.services.action import Result
from petrobot.services.vision import actions
from petrobot.services.vision.camera import Camera
from petrobot.services.vision.location import BallWindow
from petrobot.services.vision.prediction import (
    ConstantVelocity,
    Kalman,
    LeastSquares,
    Predictor,
    Surface,
)
from petrobot.sim.catching.camera import PinholeCamera
from tests.vision.bench import (
    ROOT,
    Array,
    BenchContext,
    BenchPorts,
    CameraBench,
    draw_ball,
    read_cell,
    run_action,
    true_view,
)

PICTURE = ROOT / "docs" / "pictures" / "camera.png"
ENLARGED = 1.5
LOCATORS = ("background", "mog2", "hough", "threshold", "compensated")
PREDICTORS: dict[str, Callable[[Surface], Predictor]] = {
    "constant_velocity": ConstantVelocity,
    "least_squares": LeastSquares,
    "kalman": Kalman,
}
LIGHTS: dict[str, Callable[[float], float]] = {
    "nominal": lambda time: 1.0,
    "drift": lambda time: 1.0 + 0.35 * float(np.sin(2.0 * np.pi * time / 8.0)),
    "dim": lambda time: 0.6,
    "beating": lambda time: 1.0 + 0.6 * float(np.sin(2.0 * np.pi * time)),
}


class TimedBench(CameraBench):
    """A bench that measures the CPU time of its own images."""

    own = 0.0

    def advance(self) -> None:
        begin = time.process_time()
        super().advance()
        self.own += time.process_time() - begin


class LocatorTally(Struct):
    """Results of many runs of one alternative."""

    ends: Counter[str] = field(default_factory=Counter)
    cpu: float = 0.0
    simulated: float = 0.0
    images: int = 0
    residuals: list[float] = field(default_factory=list)

    def run(self, bench: TimedBench, action: Coroutine[Any, Any, Result]) -> Result:
        """Run once; add the action's own CPU time."""
        begin, own, now = time.process_time(), bench.own, bench.now
        result = run_action(bench, action)
        self.cpu += time.process_time() - begin - (bench.own - own)
        self.simulated += bench.now - now
        self.images += int(result.values.get("images", 0))
        self.ends[f"{result.status}{':' if result.cause else ''}{result.cause}"] += 1
        if "residual" in result.values:
            self.residuals.append(float(result.values["residual"]))
        return result

    def row(self) -> str:
        """Return the results, CPU time per image (ms), and CPU time per simulated second (ms)."""
        ends = ", ".join(f"{end} {count}" for end, count in self.ends.most_common())
        residual = f"{1e3 * np.median(self.residuals):.2f}" if self.residuals else "-"
        return (
            f"{ends} | {1e3 * self.cpu / max(self.images, 1):.2f} | "
            f"{1e3 * self.cpu / self.simulated:.0f} | {residual}"
        )


def throws(
    camera: PinholeCamera, locator: str, predictor: str, regime: str, light: str, count: int
) -> tuple[LocatorTally, LocatorTally, Array]:
    """Throw balls one after the other; return errors (n, 2) of time and position, predicted 0.45 s
    before the ball leaves."""
    rng, located, tracked, errors = np.random.default_rng(3), LocatorTally(), LocatorTally(), []
    camera.reseed(np.random.default_rng(4))
    bench = TimedBench(camera, light=LIGHTS[light])
    driver = Camera({"source": "sim"}, BenchPorts(bench))
    for _ in range(count):
        bench.ball, bench.release = draw_ball(rng, regime), bench.now + float(rng.uniform(0.3, 0.8))
        context = BenchContext(bench, driver)
        found = located.run(bench, getattr(actions, f"locate_{locator}")(context))
        if "ball" in found.values:
            tracked.run(
                bench, getattr(actions, f"predict_{predictor}")(context, ball=found.values["ball"])
            )
            leaves = bench.ball.leaves()[0] + bench.release
            points = [
                (at + v[0] - leaves, v[2] - bench.ball.leaves()[1])
                for at, v in context.published
                if v and leaves - at <= 0.45
            ]
            errors += points[:1]
        while bench.now < bench.release + 4.0:
            bench.advance()
    return located, tracked, np.array(errors).reshape(-1, 2)


def print_tables(camera: PinholeCamera) -> None:
    """Print the tables of docs/vision.md."""
    print("locator, light, regime | ends of 20 | ms an image | ms a simulated second | residual mm")
    for locator in LOCATORS:
        for light, regime in (
            ("nominal", "A"),
            ("nominal", "C"),
            ("drift", "A"),
            ("dim", "A"),
            ("beating", "A"),
            ("beating", "C"),
        ):
            located, _, _ = throws(camera, locator, "least_squares", regime, light, 20)
            print(f"{locator}, {light}, {regime} | {located.row()}")
    print(
        "\npredictor, regime | ends of 20 | ms an image | ms a simulated second | - | rms at "
        "0.45 s: ms, mm"
    )
    for predictor in PREDICTORS:
        for regime in "ABC":
            _, tracked, errors = throws(camera, "background", predictor, regime, "nominal", 20)
            late, off = 1e3 * np.sqrt(np.mean(errors**2, axis=0))
            print(f"{predictor}, {regime} | {tracked.row()} | {late:.1f}, {off:.2f}")
    print("\npredictor, regime | rms after 4, 8, 12, 16 images at 50/s and 8 at 25/s: ms (mm)")
    for predictor, make in PREDICTORS.items():
        for regime in "ABC":
            cells = [
                analytic(make, regime, count, rate)
                for count, rate in ((4, 50), (8, 50), (12, 50), (16, 50), (8, 25))
            ]
            print(
                f"{predictor}, {regime} | "
                + " | ".join(f"{late:.1f} ({off:.1f})" for late, off in cells)
            )


def analytic(
    make: Callable[[Surface], Predictor], regime: str, count: int, rate: int
) -> tuple[float, float]:
    """Return rms errors (ms, mm) of the exit predicted after some images of analytic balls, with
    positions accurate to 0.3 mm."""
    rng, surface, errors = np.random.default_rng(6), Surface.of(read_cell()), []
    for _ in range(200):
        ball, predictor, first = (
            draw_ball(rng, regime),
            make(surface),
            float(rng.uniform(0, 1 / rate)),
        )
        for k in range(count):
            predictor.add(
                first + k / rate, *(ball.place(first + k / rate) + rng.normal(0, 0.0003, 2))
            )
        exit_, (leaves, y) = predictor.exit(), ball.leaves()
        if exit_ is not None:
            errors.append((exit_.time - leaves, exit_.point[1] - y))
    late, off = 1e3 * np.sqrt(np.mean(np.square(errors), axis=0))
    return float(late), float(off)


def draw_picture(camera: PinholeCamera) -> None:
    """Draw the camera's view with the positions seen, the window, and the predicted exit with two
    standard deviations."""
    camera.reseed(np.random.default_rng(4))
    bench = CameraBench(camera, draw_ball(np.random.default_rng(12), "A"))
    bench.cup = np.eye(4)
    bench.cup[:3, 3] = [0.56, 0.0, 0.55]
    bench.arm = (
        np.array(
            [[[0.05, 0.15, 0.85], [0.42, 0.05, 0.62]], [[0.42, 0.05, 0.62], [0.50, 0.0, 0.52]]]
        ),
        [0.07, 0.05],
    )
    context = BenchContext(bench, Camera({"source": "sim"}, BenchPorts(bench)))
    located = run_action(bench, actions.locate_background(context))
    tracking = actions.predict_least_squares(context, ball=located.values["ball"])
    wait, until = tracking.send(None), bench.now + 0.45
    while bench.now < until:
        bench.advance()
        if wait.ready() or (wait.due is not None and bench.now >= wait.due):
            wait = tracking.send(None)
    tracking.close()
    values = next(v for _, v in reversed(context.published) if v is not None)
    PICTURE.parent.mkdir(exist_ok=True)
    annotated = annotate(bench, context.device, located.values["ball"]["places"], values)
    cv2.imwrite(str(PICTURE), annotated, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{PICTURE.relative_to(ROOT)}: {PICTURE.stat().st_size / 1000:.0f} kB")


def annotate(
    bench: CameraBench, camera: Camera, places: list[list[float]], values: list[float]
) -> Any:
    """Draw over the current image; noise is averaged out so that the file stays small."""
    stack = np.mean([bench.picture() for _ in range(60)], axis=0)
    canvas = cv2.cvtColor(
        np.clip(np.rint(stack * 1.25 / 6) * 6, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR
    )
    canvas = cv2.resize(canvas, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_AREA)
    red, green, yellow = (80, 80, 255), (90, 220, 90), (60, 210, 255)
    for _, x, y in places:
        cv2.circle(canvas, scale(camera.view.to_pixels([x, y])), 16 * 4, yellow, 1, cv2.LINE_AA, 4)
    now = window_sees(bench, camera)
    cv2.circle(canvas, scale(now), 16 * 15, green, 2, cv2.LINE_AA, 4)
    to_go, x, y, _, _, _, _, sigma_y, sigma_t = values
    edge = camera.view.to_pixels([x, y])
    cv2.line(canvas, scale(now), scale(edge), green, 1, cv2.LINE_AA, 4)
    half = max(2.0 * sigma_y, 0.004)
    ends = [scale(camera.view.to_pixels([x, y + side])) for side in (-half, half)]
    cv2.line(canvas, ends[0], ends[1], red, 5, cv2.LINE_AA, 4)
    cv2.drawMarker(
        canvas,
        (scale(edge)[0] // 16, scale(edge)[1] // 16),
        red,
        cv2.MARKER_TILTED_CROSS,
        18,
        2,
        cv2.LINE_AA,
    )
    lines = (
        ("yellow: where it was located", yellow),
        ("green: where the window sees it now", green),
        (
            f"red: leaves in {to_go * 1e3:.0f} +- {2e3 * sigma_t:.0f} ms, y = {y * 1e3:.0f} "
            f"+- {2e3 * sigma_y:.0f} mm",
            red,
        ),
    )
    for k, (text, colour) in enumerate(lines):
        cv2.putText(
            canvas, text, (330, 620 + 26 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, 1, cv2.LINE_AA
        )
    return canvas


def window_sees(bench: CameraBench, camera: Camera) -> Array:
    """Return the ball's centre (px) as the tracker's window measures it now."""
    assert bench.ball is not None and camera.background.picture is not None
    near = camera.view.to_pixels(bench.ball.place(bench.now - bench.release)) + np.array(
        [3.0, -2.0]
    )
    seen = BallWindow(camera.view).measure(
        bench.picture(), camera.background.picture, near, spread=6.0
    )
    assert seen is not None
    return seen


def scale(pixel: Array) -> tuple[int, int]:
    """Convert a pixel of the camera to the enlarged picture, in sixteenths of its pixels."""
    u, v = (round(16 * ENLARGED * (float(c) + 0.5)) for c in pixel)
    return u, v


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tables", action="store_true")
    parser.add_argument("--picture", action="store_true")
    options = parser.parse_args()
    cell = read_cell()
    camera = PinholeCamera(cell, true_view(cell), np.random.default_rng(7))
    if options.picture:
        draw_picture(camera)
    if options.tables:
        print_tables(camera)


if __name__ == "__main__":
    main()
