"""Locating: reads images until candidates of a detector are confirmed as a ball that rolls towards
the near edge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from petrobot.services.action import Cancelled, Context, Result, error, failure, success
from petrobot.services.comm.streams.image import Image
from petrobot.services.vision.camera import Camera, CameraError, Mark
from petrobot.services.vision.confirmation import Confirmation, Track
from petrobot.services.vision.location import Detector, MixtureOfGaussians
from petrobot.services.vision.specification import Specification

LEARN_EVERY = 10
"""Images: the stored background takes in every so manieth one."""


@dataclass(frozen=True, slots=True)
class LocateSpecification(Specification):
    """When a ball counts as located, and how well (s, m)."""

    timeout: float = 5.0
    """s until no ball is an error."""
    confirmations: float = 4.0
    """Consistent detections that confirm a ball."""
    rate: float = 0.0
    """Images/s; 0: the camera's usual rate."""
    image_timeout: float = 0.8
    """s without an image until the camera counts as dead."""
    max_residual: float = 0.0015
    """m, rms of the places about a straight line of even speed: above it FAILURE `inaccurate`."""
    min_ahead: float = 1.0
    """m before the near edge at least: below it FAILURE `late`."""


async def locate(
    ctx: Context,
    name: str,
    make: Callable[[Camera], Detector],
    sigma: float,
    specification: LocateSpecification,
) -> Result:
    """Locate with the detector that `make` makes, kept by the camera under `name`; `sigma`: its
    accuracy (m).

    Images go on after SUCCESS and FAILURE, for the tracker; they end with ERROR.
    """
    camera: Camera = ctx.device
    search = _Search(ctx, camera, camera.detector(name, lambda: make(camera)), specification)
    try:
        result = await search.run(sigma)
    except (CameraError, ConnectionError) as fault:
        result = error("bad_image" if isinstance(fault, CameraError) else "no_image", str(fault))
    except Cancelled:
        camera.end()
        raise
    if result.cause in ("no_ball", "no_image", "bad_image"):
        camera.end()
    return result


class _Search:
    """One run of a locator."""

    def __init__(
        self, ctx: Context, camera: Camera, detector: Detector, specification: LocateSpecification
    ) -> None:
        self._ctx = ctx
        self._camera = camera
        self._detector = detector
        self._specification = specification
        self._confirmation = Confirmation(int(specification.confirmations))
        self._images = 0

    async def run(self, sigma: float) -> Result:
        """Read images until a ball is confirmed, or the time is over."""
        asked = self._specification
        if self._camera.start(asked.rate) and isinstance(self._detector, MixtureOfGaussians):
            self._detector.forget()
        over = self._ctx.now + asked.timeout
        silent = self._ctx.now
        while self._ctx.now < over:
            image = await self._camera.read(
                self._ctx, min(over, silent + asked.image_timeout) - self._ctx.now
            )
            if image is None and self._ctx.now >= silent + asked.image_timeout:
                return error(
                    "no_image", f"no image for {asked.image_timeout} s", images=self._images
                )
            if image is None:
                continue
            silent = self._ctx.now
            track = self._look(image)
            if track is not None:
                return self._judge(track, image, sigma)
        return error("no_ball", f"no rolling ball in {self._images} images", images=self._images)

    def _look(self, image: Image) -> Track | None:
        self._images += 1
        background = self._camera.background
        candidates = self._detector.detect(image.pixels)
        places = self._camera.view.to_table(candidates) if len(candidates) else candidates
        self._camera.marks = (Mark("candidate", pixels=candidates),)
        if not background.known or self._images % LEARN_EVERY == 0:
            background.learn(image.pixels)
        return self._confirmation.add(image.time, places)

    def _judge(self, track: Track, image: Image, sigma: float) -> Result:
        """The confirmed ball as plain data, SUCCESS when it meets the specification."""
        asked = self._specification
        ahead = float(track.places[-1, 0]) - self._camera.view.near_edge
        ball = {
            "sequence": image.sequence,
            "age": self._ctx.now - image.time,
            "sigma": sigma,
            "places": [
                [float(t - image.time), float(x), float(y)]
                for t, (x, y) in zip(track.times, track.places, strict=True)
            ],
        }
        values = {"ball": ball, "images": self._images, "residual": track.residual, "ahead": ahead}
        if ahead < asked.min_ahead:
            return failure(
                "late",
                f"confirmed {ahead:.2f} m before the near edge, not {asked.min_ahead} m",
                **values,
            )
        if track.residual > asked.max_residual:
            text = (
                f"places scatter by {track.residual * 1e3:.1f} mm, not "
                f"{asked.max_residual * 1e3:.1f} mm"
            )
            return failure("inaccurate", text, **values)
        return success(**values)
