"""Kernels of the guard: whether a pose, and the way to rest of the next commanded step, is clear.
Lengths m, angles rad.

The guard (limits.py) knows the same solids in words. Square roots and squares only, so that
compiled kernels decide as they do as they stand; sine and cosine come from the same library in
both.
"""

from __future__ import annotations

import math

from petrobot.services.host.numba_kernels import kernel
from petrobot.services.motion.trajectory import Six, braked_for, braking_times, rest_of, toward

Point = tuple[float, float, float]
Links = tuple[float, float, float, float, float]
"""d1, a2, a3, d3, d4 of the arm."""
Cup = tuple[Point, Point, float, float]
"""Mouth and outward axis in the flange's frame, length and outer radius."""
Solids = tuple[float, float, float, float, float, float, float, float]
"""Greatest x beside the table for the arm and for the cup, least z above it for each, margin to the
floor, height of the pedestal, and its radius for the wrist and for the cup, margins included."""
Radii = tuple[float, float]
"""Of forearm and wrist."""
Pose = tuple[Links, Radii, Cup, Solids]


@kernel
def within(q: Six, lower: Six, upper: Six) -> bool:
    """Whether all joints are within their limits."""
    return (
        lower[0] <= q[0] <= upper[0]
        and lower[1] <= q[1] <= upper[1]
        and lower[2] <= q[2] <= upper[2]
        and lower[3] <= q[3] <= upper[3]
        and lower[4] <= q[4] <= upper[4]
        and lower[5] <= q[5] <= upper[5]
    )


@kernel
def ball_clear(x: float, z: float, radius: float, solids: Solids) -> bool:
    """Whether a part of the forearm is clear of table and floor."""
    ahead, _, above, _, floor, _, _, _ = solids
    return (x + radius <= ahead or z - radius >= above) and z - radius >= floor


@kernel
def forearm_clear(elbow: Point, wrist: Point, radii: Radii, solids: Solids) -> bool:
    """Forearm and wrist as spheres along the forearm, clear of table, floor and pedestal."""
    thick, hand = radii
    (ex, _, ez), (x, y, z) = elbow, wrist
    _, _, _, _, _, pedestal, beside, _ = solids
    return (
        ball_clear(ex, ez, thick, solids)
        and ball_clear(ex + 0.5 * (x - ex), ez + 0.5 * (z - ez), thick, solids)
        and ball_clear(ex + 0.75 * (x - ex), ez + 0.75 * (z - ez), thick, solids)
        and ball_clear(x, z, hand, solids)
        and (z >= pedestal or x * x + y * y >= beside * beside)
    )


@kernel
def cup_clear(mouth: Point, axis: Point, length: float, radius: float, solids: Solids) -> bool:
    """The cup as a cylinder, clear of table, floor and pedestal."""
    _, ahead, _, above, floor, pedestal, _, beside = solids
    (x, y, z), (ax, ay, az) = mouth, axis
    bx, by, bz = x - length * ax, y - length * ay, z - length * az
    front = max(x, bx) + radius * math.sqrt(max(0.0, 1.0 - ax * ax))
    low = min(z, bz) - radius * math.sqrt(max(0.0, 1.0 - az * az))
    return (
        (front <= ahead or low >= above)
        and low >= floor
        and (z >= pedestal or x * x + y * y >= beside * beside)
        and (bz >= pedestal or bx * bx + by * by >= beside * beside)
    )


@kernel
def pose_clear(q: Six, links: Links, radii: Radii, cup: Cup, solids: Solids) -> bool:
    """Whether forearm and cup touch nothing in a joint pose."""
    d1, a2, a3, d3, d4 = links
    mouth, axis, length, radius = cup
    c1, s1, c23, s23 = math.cos(q[0]), math.sin(q[0]), math.cos(q[1] + q[2]), math.sin(q[1] + q[2])
    reach = a2 * math.cos(q[1]) + a3 * c23
    height = d1 + a2 * math.sin(q[1]) + a3 * s23
    elbow = (reach * c1 + d3 * s1, reach * s1 - d3 * c1, height)
    reach -= d4 * s23
    wx, wy, wz = reach * c1 + d3 * s1, reach * s1 - d3 * c1, height + d4 * c23
    if not forearm_clear(elbow, (wx, wy, wz), radii, solids):
        return False
    turn = (
        c1,
        s1,
        c23,
        s23,
        math.cos(q[3]),
        math.sin(q[3]),
        math.cos(q[4]),
        math.sin(q[4]),
        math.cos(q[5]),
        math.sin(q[5]),
    )
    x, y, z = turned(turn, mouth)
    return cup_clear((wx + x, wy + y, wz + z), turned(turn, axis), length, radius, solids)


Turn = tuple[float, float, float, float, float, float, float, float, float, float]
"""Cosine and sine of joint 1, of joints 2 and 3 together, of joints 4, 5 and 6."""


@kernel
def turned(turn: Turn, vector: Point) -> Point:
    """A vector of frame 6 in the base frame."""
    c1, s1, c23, s23, c4, s4, c5, s5, c6, s6 = turn
    x, y, z = vector
    x, y = c6 * x - s6 * y, s6 * x + c6 * y
    x, z = c5 * x - s5 * z, s5 * x + c5 * z  # the twists before and after joint 5 cancel
    x, y = c4 * x - s4 * y, s4 * x + c4 * y
    radial, up = c23 * x - s23 * z, s23 * x + c23 * z
    return c1 * radial - s1 * y, s1 * radial + c1 * y, up


@kernel
def clear(
    q: Six, lower: Six, upper: Six, links: Links, radii: Radii, cup: Cup, solids: Solids
) -> bool:
    """Whether a joint pose is within the limits and touches nothing."""
    return within(q, lower, upper) and pose_clear(q, links, radii, cup, solids)


@kernel
def farther(a: Six, b: Six, limit: float) -> bool:
    """Whether a joint is more than `limit` away from where it is in another pose."""
    return (
        abs(a[0] - b[0]) > limit
        or abs(a[1] - b[1]) > limit
        or abs(a[2] - b[2]) > limit
        or abs(a[3] - b[3]) > limit
        or abs(a[4] - b[4]) > limit
        or abs(a[5] - b[5]) > limit
    )


@kernel
def clear_step(
    period: float,
    near: float,
    q: Six,
    qd: Six,
    target: Six,
    speed: Six,
    acceleration: Six,
    brakes: Six,
    lower: Six,
    upper: Six,
    links: Links,
    radii: Radii,
    cup: Cup,
    solids: Solids,
) -> tuple[Six, Six, bool]:
    """The next cycle toward `target`: positions and velocities after it, and whether the arm can
    come to rest from there.

    A way to rest of more than `near` rad is looked at where it begins, after a quarter and after
    half of its time.
    """
    q, qd = toward(period, q, qd, target, speed, acceleration)
    rest = rest_of(period, q, qd, brakes)
    if not clear(rest, lower, upper, links, radii, cup, solids):
        return q, qd, False
    if not farther(rest, q, near):
        return q, qd, True
    times = braking_times(period, qd, brakes)
    longest = max(times)
    return (
        q,
        qd,
        clear(q, lower, upper, links, radii, cup, solids)
        and clear(braked_for(0.25 * longest, q, qd, times), lower, upper, links, radii, cup, solids)
        and clear(braked_for(0.5 * longest, q, qd, times), lower, upper, links, radii, cup, solids),
    )
