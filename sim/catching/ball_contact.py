"""Contact of the ball with table and cup in this project's own code, for the portable back end.

A step of 1 ms advances the ball along its parabola to the next impact, applies an impulse, and
advances it from there. What it may touch: the table, a box; the two nearest of the flat walls of
the cup, boxes; the bottom of the cup, a disc. A ball that flies past an edge may graze it unseen
where both ends of a step are free: at 5 m/s by 0.2 mm.

* Impact: the ball leaves with the coefficient of restitution times its speed of approach. Friction
  acts with at most its coefficient times the normal impulse, and less if the point of contact grips
  before that (Coulomb's law for impulses). Rolling resistance acts as a torque: the normal impulse
  times a lever arm.
* Lasting contact, which begins where the speed of approach is below `_BOUNCE`: the impulses of a
  step that keep the ball out of all surfaces at the step's end, found by relaxing one contact after
  the other (projected Gauss-Seidel, as in time-stepping contact solvers).

The motion of the cup is given; the ball has no effect on it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from petrobot.services.host.numba_kernels import kernel, packed
from petrobot.sim.catching.ball import BallModel, BallState
from petrobot.sim.catching.physics import TABLE_TOP
from petrobot.sim.catching.puma_model import Frame3, twist
from petrobot.sim.catching.truth import CupTruth, TableTruth

Triple = tuple[float, float, float]
Contact = tuple[float, float, float, float]
"""Gap (m, negative: overlap) between ball and a surface, and the surface's normal there."""
Ball = tuple[float, float, float, float, float, float]
"""Velocity (m/s) and spin (rad/s) of the ball."""
Impulse = tuple[float, float, float, float, float, float, float]
"""Of one contact, per mass of the ball: normal (m/s), friction (x, y, z; m/s), and the change of
spin by rolling resistance (x, y, z; rad/s)."""
Cup = tuple[Triple, Triple, Triple]
"""Middle of the cup's mouth (m), its axis, out of the mouth, and its x axis, on which the first
wall stands."""
Motion = tuple[Triple, Triple]
"""Velocity of the cup's mouth (m/s) and the cup's angular velocity (rad/s)."""
Impulses = tuple[Impulse, Impulse, Impulse, Impulse]
"""One for each surface: table, nearest wall of the cup, the next wall, bottom of the cup."""
Flags = tuple[bool, bool, bool, bool]
"""One for each surface."""
Gaps = tuple[float, float, float, float]
"""One for each surface (m)."""

_TOUCH = 1e-5
"""m; a smaller gap counts as contact."""
_FAR = 1e-3
"""m; a surface that is farther away need not be looked at, whatever the gap exactly is."""
_EDGE = 0.001
"""Radius of the edges of the cup's walls (m): that of Bullet's boxes."""
_BOUNCE = 0.05
"""m/s; slower impacts do not rebound. Bullet's threshold is set to the same."""
_PRESSED = 0.3
"""m/s; the same for a contact that lasts: along a curved wall the normal turns from step to step,
which looks like an approach."""
_ROUNDS = 8
"""Rounds of relaxation at most."""
_CONVERGED = 1e-5
"""m/s; a round that changes velocity and spin by less is the last one."""
_IMPACTS = 12
"""Impacts in one step at most."""

# The kernels below take and return plain floats, not vectors: without numba, calls and tuples cost
# more than the arithmetic.

# Geometry. `numbers`: see `numbers_of`.


@kernel
def _at_table(p: Triple, numbers: Sequence[float]) -> Contact:
    """Return the contact with the box of the table top."""
    x, y, z = p
    r, near, far, half = numbers[2], numbers[4], numbers[5], numbers[6]
    top, bottom = numbers[7], numbers[8]
    dx = x - near if x < near else x - far if x > far else 0.0
    dy = y + half if y < -half else y - half if y > half else 0.0
    dz = z - top if z > top else z - bottom if z < bottom else 0.0
    square = dx * dx + dy * dy + dz * dz
    if square == 0.0:  # the centre is inside the table: out by the top
        return z - top - r, 0.0, 0.0, 1.0
    distance = math.sqrt(square)
    return distance - r, dx / distance, dy / distance, dz / distance


@kernel
def _at_wall(p: Triple, cup: Cup, following: bool, numbers: Sequence[float]) -> Contact:
    """Return the contact with the nearest of the cup's walls, or with the one `following` it."""
    (ox, oy, oz), (zx, zy, zz), (xx, xy, xz) = cup
    r, radius, depth, wall, count = numbers[2], numbers[11], numbers[12], numbers[13], numbers[17]
    dx, dy, dz = p[0] - ox, p[1] - oy, p[2] - oz
    height = dx * zx + dy * zy + dz * zz
    yx, yy, yz = zy * xz - zz * xy, zz * xx - zx * xz, zx * xy - zy * xx
    x, y = dx * xx + dy * xy + dz * xz, dx * yx + dy * yy + dz * yz
    turn = 2.0 * math.pi / count
    number = math.atan2(y, x) / turn
    nearest = float(math.floor(number + 0.5))
    if following:
        nearest = nearest + (1.0 if number > nearest else -1.0)
    c, s = math.cos(nearest * turn), math.sin(nearest * turn)
    out, along, half = c * x + s * y, c * y - s * x, numbers[18]
    # The edges are round: a box that is smaller by their radius, and that radius around it.
    edge = _EDGE
    off = out - radius - edge
    if off > 0.0:
        off = off - wall + 2.0 * edge if off > wall - 2.0 * edge else 0.0
    half = half - edge
    side = along + half if along < -half else along - half if along > half else 0.0
    low, high = edge - depth, -edge
    up = height - low if height < low else height - high if height > high else 0.0
    square = off * off + side * side + up * up
    if square > 0.0:
        distance = math.sqrt(square)
        off, side, up = off / distance, side / distance, up / distance
    elif out - radius < 0.5 * wall:  # the centre is in the wall: out by its nearer side
        distance, off = radius + edge - out, -1.0
    else:
        distance, off = out - radius - wall + edge, 1.0
    a, b = c * off - s * side, s * off + c * side
    return (
        distance - edge - r,
        a * xx + b * yx + up * zx,
        a * xy + b * yy + up * zy,
        a * xz + b * yz + up * zz,
    )


@kernel
def _at_bottom(p: Triple, cup: Cup, numbers: Sequence[float]) -> Contact:
    """Return the contact with the disc of the cup's bottom."""
    (ox, oy, oz), (zx, zy, zz), _ = cup
    r, high, rim = numbers[2], -numbers[12], numbers[11] + numbers[13]
    dx, dy, dz = p[0] - ox, p[1] - oy, p[2] - oz
    height = dx * zx + dy * zy + dz * zz
    dx, dy, dz = dx - height * zx, dy - height * zy, dz - height * zz
    aside, low = math.sqrt(dx * dx + dy * dy + dz * dz), high - numbers[13]
    off = aside - rim if aside > rim else 0.0
    up = height - low if height < low else height - high if height > high else 0.0
    square = off * off + up * up
    if square == 0.0:  # the centre is in the bottom: out to the mouth
        return height - high - r, zx, zy, zz
    distance = math.sqrt(square)
    up = up / distance
    off = off / distance / aside if off > 0.0 else 0.0
    return distance - r, off * dx + up * zx, off * dy + up * zy, off * dz + up * zz


@kernel
def contact_at(surface: int, p: Triple, cup: Cup, numbers: Sequence[float]) -> Contact:
    """Return the contact of a ball at `p` with the table (0), the nearest (1) and the next wall (2)
    or the bottom (3) of the cup."""
    if surface == 0:
        return _at_table(p, numbers)
    if surface == 3:
        return _at_bottom(p, cup, numbers)
    return _at_wall(p, cup, surface == 2, numbers)


# Impulses


@kernel
def _pushed(
    ball: Ball,
    impulse: Impulse,
    contact: Contact,
    least: float,
    surface: Triple,
    turning: Triple,
    friction: float,
    lever: float,
    r: float,
    k: float,
) -> tuple[Ball, Impulse]:
    """Return velocity and spin, and the impulse of a contact, after it was changed so that the
    ball's velocity along the normal is at least `least` (m/s).

    `surface` (m/s) and `turning` (rad/s) are the velocities of the surface at the point of contact;
    `lever` (m) is the arm of rolling resistance, `k` the ball's inertia factor.
    """
    vx, vy, vz, wx, wy, wz = ball
    before, fx, fy, fz, lx, ly, lz = impulse
    _, nx, ny, nz = contact
    push = before + least - (vx * nx + vy * ny + vz * nz)
    if push < 0.0:
        push = 0.0
    change = push - before
    vx, vy, vz = vx + change * nx, vy + change * ny, vz + change * nz
    # Friction would stop the slip of the point of contact, which moves with v - r w x n. An impulse
    # g per mass changes it by g as speed and by g / k as spin, so k / (1 + k) of the slip is enough
    # (2/7 for a solid ball, 2/5 for a hollow one).
    sx = vx - r * (wy * nz - wz * ny) - surface[0]
    sy = vy - r * (wz * nx - wx * nz) - surface[1]
    sz = vz - r * (wx * ny - wy * nx) - surface[2]
    along, share = sx * nx + sy * ny + sz * nz, k / (1.0 + k)
    gx = fx - share * (sx - along * nx)
    gy = fy - share * (sy - along * ny)
    gz = fz - share * (sz - along * nz)
    square, most = gx * gx + gy * gy + gz * gz, friction * push
    if square > most * most:
        cut = most / math.sqrt(square)
        gx, gy, gz = gx * cut, gy * cut, gz * cut
    dx, dy, dz, spun = gx - fx, gy - fy, gz - fz, 1.0 / (k * r)
    vx, vy, vz = vx + dx, vy + dy, vz + dz
    wx = wx - spun * (ny * dz - nz * dy)
    wy = wy - spun * (nz * dx - nx * dz)
    wz = wz - spun * (nx * dy - ny * dx)
    if lever > 0.0:
        # Rolling resistance would stop the rotation about all axes but the normal.
        sx, sy, sz = wx - turning[0], wy - turning[1], wz - turning[2]
        along = sx * nx + sy * ny + sz * nz
        hx, hy, hz = lx - (sx - along * nx), ly - (sy - along * ny), lz - (sz - along * nz)
        square, most = hx * hx + hy * hy + hz * hz, lever * push / (k * r * r)
        if square > most * most:
            cut = most / math.sqrt(square)
            hx, hy, hz = hx * cut, hy * cut, hz * cut
        wx, wy, wz = wx + (hx - lx), wy + (hy - ly), wz + (hz - lz)
        lx, ly, lz = hx, hy, hz
    return (vx, vy, vz, wx, wy, wz), (push, gx, gy, gz, lx, ly, lz)


@kernel
def _surface_velocity(
    on: int, contact: Contact, p: Triple, o: Triple, motion: Motion, r: float
) -> Triple:
    """Return the velocity (m/s) of a surface at the point where a ball at `p` touches it. `motion`:
    velocity of the mouth and angular velocity of the cup."""
    if on == 0:
        return 0.0, 0.0, 0.0
    _, nx, ny, nz = contact
    (vx, vy, vz), (wx, wy, wz) = motion
    x, y, z = p[0] - r * nx - o[0], p[1] - r * ny - o[1], p[2] - r * nz - o[2]
    return vx + wy * z - wz * y, vy + wz * x - wx * z, vz + wx * y - wy * x


@kernel
def _bounced(
    p: Triple,
    ball: Ball,
    cup: Cup,
    motion: Motion,
    near: Flags,
    pressed: Flags,
    numbers: Sequence[float],
) -> Ball:
    """Return velocity and spin after the impacts of this moment: on every surface that the ball
    touches and approaches fast enough to bounce."""
    r, k = numbers[2], numbers[3]
    for _ in range(4):  # in an edge, one impact may cause the next
        done = True
        for on in range(4):
            if not near[on]:
                continue
            contact = contact_at(on, p, cup, numbers)
            _, nx, ny, nz = contact
            surface = _surface_velocity(on, contact, p, cup[0], motion, r)
            towards = ball[0] * nx + ball[1] * ny + ball[2] * nz
            away = towards - (surface[0] * nx + surface[1] * ny + surface[2] * nz)
            if away > (-_PRESSED if pressed[on] else -_BOUNCE):
                continue
            done = False
            on_cup = on > 0
            least = towards - (1.0 + (numbers[14] if on_cup else numbers[9])) * away
            turning = motion[1] if on_cup else (0.0, 0.0, 0.0)
            friction = numbers[15] if on_cup else numbers[10]
            lever = numbers[16] if on_cup else 0.0
            impulse = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            for _ in range(3):  # friction and rolling resistance act on each other
                ball, impulse = _pushed(
                    ball, impulse, contact, least, surface, turning, friction, lever, r, k
                )
        if done:
            break
    return ball


@kernel
def _begun(ball: Ball, impulse: Impulse, contact: Contact, r: float, k: float) -> Ball:
    """Return velocity and spin after a guessed impulse."""
    vx, vy, vz, wx, wy, wz = ball
    push, fx, fy, fz, lx, ly, lz = impulse
    if push == 0.0:
        return ball
    _, nx, ny, nz = contact
    spun = 1.0 / (k * r)
    return (
        vx + push * nx + fx,
        vy + push * ny + fy,
        vz + push * nz + fz,
        wx + lx - spun * (ny * fz - nz * fy),
        wy + ly - spun * (nz * fx - nx * fz),
        wz + lz - spun * (nx * fy - ny * fx),
    )


@kernel
def _kept_out(
    p: Triple,
    ball: Ball,
    left: float,
    now: Cup,
    later: Cup,
    motion: Motion,
    near: Flags,
    guess: Impulses,
    numbers: Sequence[float],
) -> tuple[Ball, Impulses]:
    """Return velocity and spin after `left` seconds in contact with the surfaces that are `near`,
    and the impulses: the ball then overlaps none of them. `now`, `later`: the cup at the begin and
    then. `guess`: impulses to begin with; those of the step before are nearly right."""
    r, k = numbers[2], numbers[3]
    vx, vy, vz, wx, wy, wz = ball
    vz = vz - numbers[1] * left
    ball = (vx, vy, vz, wx, wy, wz)
    free = (p[0] + left * vx, p[1] + left * vy, p[2] + left * vz)
    still = (0.0, 0.0, 0.0)
    first, second, third, fourth = guess
    one = two = three = four = (0.0, 0.0, 0.0, 0.0)
    by_one = by_two = by_three = by_four = still
    # Least velocities along the normals with which the gaps at the end are not negative.
    least_one = least_two = least_three = least_four = 0.0
    if near[0]:
        one = contact_at(0, free, later, numbers)
        least_one = vx * one[1] + vy * one[2] + vz * one[3] - one[0] / left
        ball = _begun(ball, first, one, r, k)
    if near[1]:
        two = contact_at(1, free, later, numbers)
        least_two = vx * two[1] + vy * two[2] + vz * two[3] - two[0] / left
        by_two = _surface_velocity(1, two, p, now[0], motion, r)
        ball = _begun(ball, second, two, r, k)
    if near[2]:
        three = contact_at(2, free, later, numbers)
        least_three = vx * three[1] + vy * three[2] + vz * three[3] - three[0] / left
        by_three = _surface_velocity(2, three, p, now[0], motion, r)
        ball = _begun(ball, third, three, r, k)
    if near[3]:
        four = contact_at(3, free, later, numbers)
        least_four = vx * four[1] + vy * four[2] + vz * four[3] - four[0] / left
        by_four = _surface_velocity(3, four, p, now[0], motion, r)
        ball = _begun(ball, fourth, four, r, k)
    rough, lever = numbers[15], numbers[16]
    for _ in range(_ROUNDS):
        before = ball
        if near[0]:
            ball, first = _pushed(
                ball, first, one, least_one, by_one, still, numbers[10], 0.0, r, k
            )
        if near[1]:
            ball, second = _pushed(
                ball, second, two, least_two, by_two, motion[1], rough, lever, r, k
            )
        if near[2]:
            ball, third = _pushed(
                ball, third, three, least_three, by_three, motion[1], rough, lever, r, k
            )
        if near[3]:
            ball, fourth = _pushed(
                ball, fourth, four, least_four, by_four, motion[1], rough, lever, r, k
            )
        dx, dy, dz = ball[0] - before[0], ball[1] - before[1], ball[2] - before[2]
        ex, ey, ez = ball[3] - before[3], ball[4] - before[4], ball[5] - before[5]
        change = dx * dx + dy * dy + dz * dz + r * r * (ex * ex + ey * ey + ez * ez)
        if change < _CONVERGED * _CONVERGED:
            break
    return ball, (first, second, third, fourth)


@kernel
def _cup_at(before: Cup, after: Cup, share: float) -> Cup:
    """Return the cup at a share of its way through a step."""
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = before
    (dx, dy, dz), (ex, ey, ez), (fx, fy, fz) = after
    return (
        (ax + share * (dx - ax), ay + share * (dy - ay), az + share * (dz - az)),
        (bx + share * (ex - bx), by + share * (ey - by), bz + share * (ez - bz)),
        (cx + share * (fx - cx), cy + share * (fy - cy), cz + share * (fz - cz)),
    )


@kernel
def _impact_time(
    on: int,
    p: Triple,
    drift: Triple,
    fall: float,
    at: float,
    left: float,
    before: Cup,
    after: Cup,
    gap_high: float,
    numbers: Sequence[float],
) -> float:
    """Return the seconds, up to `left`, after which the ball meets a surface, from `p` with
    velocity `drift` and acceleration `fall` downwards; `gap_high` < 0 is the gap at their end.
    `at`: seconds since the begin of the step. Regula falsi; every fourth time the interval is
    halved."""
    low, high, goal = 0.0, left, 0.25 * _TOUCH
    gap_low = contact_at(on, p, _cup_at(before, after, at / numbers[0]), numbers)[0]
    for turn in range(40):
        s = low + (high - low) * (gap_low - goal) / (gap_low - gap_high)
        if turn % 4 == 3:
            s = 0.5 * (low + high)
        there = (p[0] + drift[0] * s, p[1] + drift[1] * s, p[2] + drift[2] * s - 0.5 * fall * s * s)
        gap = contact_at(on, there, _cup_at(before, after, (at + s) / numbers[0]), numbers)[0]
        if 0.0 <= gap <= 0.5 * _TOUCH:
            return s
        if gap > 0.0:
            low, gap_low = s, gap
        else:
            high, gap_high = s, gap
    return low


@kernel
def stepped_ball(
    p: Triple,
    ball: Ball,
    before: Cup,
    after: Cup,
    motion: Motion,
    pressed: Flags,
    guess: Impulses,
    fresh: bool,
    numbers: Sequence[float],
) -> tuple[Triple, Ball, Flags, Impulses]:
    """Return position, velocity and spin of the ball after a step, which surfaces it touches, and
    the impulses of those.

    `before`, `after`: the cup at both ends of the step; `motion`: velocity of its mouth and its
    angular velocity; `pressed`, `guess`: which surfaces the ball touched at the end of the step
    before, and their impulses; `fresh`: there was none, the ball was put here.
    """
    dt, gravity = numbers[0], numbers[1]
    nothing = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    none = (nothing, nothing, nothing, nothing)
    at, near, cup = 0.0, pressed, before
    for _ in range(_IMPACTS):
        left = dt - at
        if fresh or at > 0.0:
            cup = _cup_at(before, after, at / dt)
            near = (
                contact_at(0, p, cup, numbers)[0] <= _TOUCH,
                contact_at(1, p, cup, numbers)[0] <= _TOUCH,
                contact_at(2, p, cup, numbers)[0] <= _TOUCH,
                contact_at(3, p, cup, numbers)[0] <= _TOUCH,
            )
        if near[0] or near[1] or near[2] or near[3]:
            ball = _bounced(p, ball, cup, motion, near, pressed, numbers)
            then, guess = _kept_out(p, ball, left, cup, after, motion, near, guess, numbers)
            drift, fall = (then[0], then[1], then[2]), 0.0
        else:
            then = (ball[0], ball[1], ball[2] - gravity * left, ball[3], ball[4], ball[5])
            drift, fall, guess = (ball[0], ball[1], ball[2]), gravity, none
        end = (
            p[0] + drift[0] * left,
            p[1] + drift[1] * left,
            p[2] + drift[2] * left - 0.5 * fall * left * left,
        )
        soonest, gaps = left, _gaps(end, after, near, numbers)
        for on in range(4):
            if gaps[on] < 0.0:
                s = _impact_time(on, p, drift, fall, at, left, before, after, gaps[on], numbers)
                soonest = min(soonest, s)
        if soonest >= left:
            end, near = _out(end, after, near, gaps, numbers)
            return end, then, near, guess if at == 0.0 else none
        s = soonest
        p = (p[0] + drift[0] * s, p[1] + drift[1] * s, p[2] + drift[2] * s - 0.5 * fall * s * s)
        s = soonest / left
        ball = (
            ball[0] + s * (then[0] - ball[0]),
            ball[1] + s * (then[1] - ball[1]),
            ball[2] + s * (then[2] - ball[2]),
            ball[3] + s * (then[3] - ball[3]),
            ball[4] + s * (then[4] - ball[4]),
            ball[5] + s * (then[5] - ball[5]),
        )
        at, guess = at + soonest, none
        pressed = (
            pressed[0] and near[0],
            pressed[1] and near[1],
            pressed[2] and near[2],
            pressed[3] and near[3],
        )
    everywhere = (True, True, True, True)
    p, near = _out(p, after, everywhere, (0.0, 0.0, 0.0, 0.0), numbers)
    return p, ball, near, none


@kernel
def _gaps(p: Triple, cup: Cup, near: Flags, numbers: Sequence[float]) -> Gaps:
    """Return the gaps to the surfaces that are not `near`, 0 for the others. The next wall is never
    nearer than the nearest one: if that is out of reach, its gap counts for both. A surface that is
    clearly out of reach has the gap `_FAR`: that costs less than to compute it."""
    r = numbers[2]
    reach = r + _FAR
    table, wall, bottom = _FAR, _FAR, _FAR
    if near[0]:
        table = 0.0
    elif p[2] < numbers[7] + reach and p[0] > numbers[4] - reach:
        table = _at_table(p, numbers)[0]
    (ox, oy, oz), (zx, zy, zz), _ = cup
    dx, dy, dz = p[0] - ox, p[1] - oy, p[2] - oz
    height, radius = dx * zx + dy * zy + dz * zz, numbers[11]
    inside = radius - reach
    if near[1]:
        wall = 0.0
    elif height < reach and (
        inside <= 0.0 or dx * dx + dy * dy + dz * dz - height * height > inside * inside
    ):
        wall = contact_at(1, p, cup, numbers)[0]
    following = wall
    if near[2]:
        following = 0.0
    elif wall <= 2.0 * _TOUCH:
        following = contact_at(2, p, cup, numbers)[0]
    if near[3]:
        bottom = 0.0
    elif height < reach - numbers[12]:
        bottom = _at_bottom(p, cup, numbers)[0]
    return table, wall, following, bottom


@kernel
def _out(
    p: Triple, cup: Cup, near: Flags, gaps: Gaps, numbers: Sequence[float]
) -> tuple[Triple, Flags]:
    """Return where the ball is at the end of a step, and which surfaces it touches. It is moved out
    of what it still overlaps, by some micrometres where a surface is curved or the cup turns.
    `gaps`: those at `p` to the surfaces that were not `near`."""
    one = two = three = four = False
    moved = False
    for _ in range(2):
        again, moved = moved, False
        for on in range(4):
            if near[on] or again or moved:
                gap, nx, ny, nz = contact_at(on, p, cup, numbers)
            else:
                gap, nx, ny, nz = gaps[on], 0.0, 0.0, 0.0
            if gap < 0.0:
                p = (p[0] - gap * nx, p[1] - gap * ny, p[2] - gap * nz)
                moved = True
            if on == 0:
                one = gap <= _TOUCH
            elif on == 1:
                two = gap <= _TOUCH
            elif on == 2:
                three = gap <= _TOUCH
            else:
                four = gap <= _TOUCH
        if not moved:
            break
    return p, (one, two, three, four)


_NO_IMPULSE: Impulse = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_NO_IMPULSES: Impulses = (_NO_IMPULSE, _NO_IMPULSE, _NO_IMPULSE, _NO_IMPULSE)

_SOMEWHERE = Frame3((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))


class OwnBallContact:
    """Ball, table and cup. Everything in the base frame. Implements `physics.BallContact`."""

    def __init__(
        self,
        model: BallModel,
        table: TableTruth,
        cup: CupTruth,
        wall: float,
        settings: Mapping[str, Any],
    ) -> None:
        """`wall`: thickness of the cup's wall and bottom (m); `settings`: the laboratory file."""
        self.dt = float(settings["step"]["contact"])
        self._numbers = numbers_of(model, table, cup, wall, settings)
        self.put_ball(BallState((0.0, 0.0, -10.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
        # Compile the kernels, or load them from the cache, now and not at the first contact.
        self.step(_SOMEWHERE, _SOMEWHERE)

    def put_ball(self, state: BallState) -> None:
        """Set the ball's state."""
        (x, y, z), (a, b, c), (d, e, f) = state
        self._position: Triple = float(x), float(y), float(z)
        self._ball: Ball = float(a), float(b), float(c), float(d), float(e), float(f)
        self._pressed: Flags = (False, False, False, False)
        self._impulses = _NO_IMPULSES
        self._fresh = True

    def ball(self) -> BallState:
        """Return the ball's state."""
        a, b, c, d, e, f = self._ball
        return BallState(self._position, (a, b, c), (d, e, f))

    def step(self, before: Frame3, after: Frame3) -> BallState:
        """Step by `dt` while the cup moves from `before` to `after` (origin: mouth centre, z out of
        the mouth)."""
        self._position, self._ball, self._pressed, self._impulses = stepped_ball(
            self._position,
            self._ball,
            (before.origin, before.z, before.x),
            (after.origin, after.z, after.x),
            twist(before, after, self.dt),
            self._pressed,
            self._impulses,
            self._fresh,
            self._numbers,
        )
        self._fresh = False
        return self.ball()

    def close(self) -> None:
        """Release nothing: this back end holds nothing outside Python."""


def numbers_of(
    model: BallModel, table: TableTruth, cup: CupTruth, wall: float, settings: Mapping[str, Any]
) -> Sequence[float]:
    """Return the numbers that the kernels read by index: step (s), gravity, radius, inertia factor;
    near and far edge, half width, top and underside of the table, its restitution and friction;
    radius, depth and wall of the cup, its restitution, friction, and the lever arm of its rolling
    resistance (m); number of its walls, and half the width of one (m)."""
    ball, rough = settings["ball"], settings["cup"]
    return packed(
        stepped_ball,
        [
            *(settings["step"]["contact"], model.gravity, model.radius, model.inertia_factor),
            *(table.near_edge, table.far_edge, table.half_width, table.top, table.top - TABLE_TOP),
            *(ball["table_restitution"], ball["friction"]),
            *(cup.radius, cup.depth, wall, cup.restitution, rough["friction"]),
            rough["rolling_resistance"] * model.radius,
            rough["walls"],
            (cup.radius + wall) * math.tan(math.pi / rough["walls"]),
        ],
    )
