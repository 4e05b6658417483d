"""Primitive actions of the rover's camera: find the track in four ways, and watch it until it ends.

All stream what each image shows as set points of `track_ahead`
(`services.mobile.sight.TrackAhead`), even that it shows nothing: a silent stream means a dead
camera. Error causes: `no_line`, `no_image`, `bad_image`.
"""

from __future__ import annotations

from typing import Final

from petrobot.services.action import Cancelled, Context, Result, error, failure, success
from petrobot.services.camera import CameraError
from petrobot.services.mobile.camera import FloorCamera
from petrobot.services.mobile.detection import (
    TemplateBank,
    TrackDetector,
    consensus,
    detect_edges,
    detect_ridge,
)
from petrobot.services.mobile.sight import Sight, TrackAhead, TrackEnd, thinned
from petrobot.services.mobile.watching import LineWatcher

STREAM: Final = "track_ahead"
CONFIRMED: Final = 3
"""Images in a row that must show a line before it counts as found."""
GONE: Final = 2
"""Images without the line after which a line with a known end has passed out of view."""
PATCHY: Final = 0.9
"""Share of images below which a watched line was not seen well enough: FAILURE."""


async def find_edges(ctx: Context, *, timeout: float = 30.0, image_timeout: float = 0.5) -> Result:
    """Find the track by pairs of edges: cheapest.

    SUCCESS when three images in a row show a line; ERROR `no_line` after `timeout` s.
    """
    return await _find(ctx, detect_edges, timeout, image_timeout)


async def find_ridge(ctx: Context, *, timeout: float = 30.0, image_timeout: float = 0.5) -> Result:
    """Find the track by ridges of its width: averages noise. Otherwise as `find_edges`."""
    return await _find(ctx, detect_ridge, timeout, image_timeout)


async def find_consensus(
    ctx: Context, *, timeout: float = 30.0, image_timeout: float = 0.5
) -> Result:
    """Find the track by random sample consensus of a parabola: tolerates false edges. Otherwise as
    `find_edges`."""
    return await _find(ctx, consensus(lambda: ctx.random("consensus")), timeout, image_timeout)


async def find_template(
    ctx: Context, *, timeout: float = 30.0, image_timeout: float = 0.5
) -> Result:
    """Find the track by whole-line templates: tolerates noise and dim light best, costs most.
    Otherwise as `find_edges`."""
    return await _find(ctx, TemplateBank(), timeout, image_timeout)


async def watch_edges(
    ctx: Context, *, lost_after: float = 0.8, image_timeout: float = 0.5
) -> Result:
    """Stream the track ahead until it ends, by pairs of edges.

    SUCCESS when an interruption or the T has been recognised and has passed below the image; `at_t`
    says which. FAILURE `patchy` (same values) when the line was missing in too many images. ERROR
    `no_line` when it was lost without an end.
    """
    return await _watch(ctx, detect_edges, lost_after, image_timeout)


async def watch_ridge(
    ctx: Context, *, lost_after: float = 0.8, image_timeout: float = 0.5
) -> Result:
    """Stream the track ahead until it ends, by ridges of its width. Otherwise as `watch_edges`."""
    return await _watch(ctx, detect_ridge, lost_after, image_timeout)


async def watch_consensus(
    ctx: Context, *, lost_after: float = 0.8, image_timeout: float = 0.5
) -> Result:
    """Stream the track ahead until it ends, by random sample consensus. Otherwise as
    `watch_edges`."""
    return await _watch(ctx, consensus(lambda: ctx.random("consensus")), lost_after, image_timeout)


async def watch_template(
    ctx: Context, *, lost_after: float = 0.8, image_timeout: float = 0.5
) -> Result:
    """Stream the track ahead until it ends, by whole-line templates. Otherwise as `watch_edges`."""
    return await _watch(ctx, TemplateBank(), lost_after, image_timeout)


async def _find(
    ctx: Context, detector: TrackDetector, timeout: float, image_timeout: float
) -> Result:
    camera: FloorCamera = ctx.device
    watcher = LineWatcher(camera.floor, detector, find=True)
    until, row = ctx.now + timeout, 0
    try:
        camera.start()
        while ctx.now < until:
            sight = await _next(ctx, camera, watcher, image_timeout)
            if isinstance(sight, Result):
                return sight
            row = row + 1 if sight.seen else 0
            if row == CONFIRMED:
                shape = sight.describe()
                values = {
                    "offset": shape.offset,
                    "heading": shape.heading,
                    "curvature": shape.curvature,
                }
                return success(images=watcher.images, **values)
    except Cancelled:
        ctx.withdraw(STREAM)
        raise
    return error("no_line", f"no line was seen in {timeout} s", images=watcher.images)


async def _watch(
    ctx: Context, detector: TrackDetector, lost_after: float, image_timeout: float
) -> Result:
    camera: FloorCamera = ctx.device
    watcher = LineWatcher(camera.floor, detector)
    ended = TrackEnd.NONE
    seen_at = ctx.now
    try:
        camera.start()
        while True:
            sight = await _next(ctx, camera, watcher, image_timeout)
            if isinstance(sight, Result):
                return sight
            if sight.end is not None:
                ended = sight.end.kind
            elif sight.seen and not sight.broke_off:
                ended = TrackEnd.NONE
            if sight.seen:
                seen_at = ctx.now
            elif ended is not TrackEnd.NONE and watcher.unseen >= GONE:
                return _ended(ended, watcher)
            elif ctx.now - seen_at > lost_after:
                return error(
                    "no_line", f"the line was lost for {lost_after} s", images=watcher.images
                )
    except Cancelled:
        ctx.withdraw(STREAM)
        raise


def _ended(kind: TrackEnd, watcher: LineWatcher) -> Result:
    values = {"at_t": kind is TrackEnd.T, "images": watcher.images, "share": watcher.share}
    if watcher.share < PATCHY:
        return failure(
            "patchy", f"the line was seen in only {watcher.share:.0%} of the images", **values
        )
    return success(**values)


async def _next(
    ctx: Context, camera: FloorCamera, watcher: LineWatcher, image_timeout: float
) -> Sight | Result:
    """Return what the next image shows, and stream it; or return the result of the run without
    one."""
    try:
        image = await camera.read(ctx, image_timeout)
    except CameraError as fault:
        return error("bad_image", str(fault))
    if image is None:
        camera.end()  # The next run opens the source again.
        text = camera.missing(f"no image for {image_timeout} s")
        return error("no_image", text, images=watcher.images)
    sight = watcher.look(image.pixels)
    ahead = TrackAhead(max(0.0, ctx.now - image.time), sight.confidence, sight.end, thinned(sight))
    ctx.publish(STREAM, ahead.values())
    return sight
