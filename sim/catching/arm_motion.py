"""One step of the arm's joints as pure numbers: motors, semi-implicit Euler, dry friction, hard
stops. Kernels of sim/catching/puma.py."""

from __future__ import annotations

from collections.abc import Sequence

from petrobot.services.host.numba_kernels import kernel

Six = tuple[float, float, float, float, float, float]
"""One number per joint, base to flange."""
Matrix = tuple[Six, Six, Six, Six, Six, Six]

STILL = 1e-4
"""rad/s; a joint that is slower than this and held by friction stops."""
FADE = 0.15
"""Share of its greatest speed within which the motor's torque fades to nothing above that speed
(back EMF)."""


@kernel
def motor(tau: float, limit: float, speed: float, greatest: float) -> float:
    """Return the torque (N m) of a motor for the requested torque `tau`: within its limit; beyond
    its greatest speed less, finally none, of what would accelerate it."""
    high = low = limit
    if speed > greatest:
        high = max(0.0, 1.0 - (speed / greatest - 1.0) / FADE) * limit
    elif speed < -greatest:
        low = max(0.0, 1.0 - (-speed / greatest - 1.0) / FADE) * limit
    return high if tau > high else -low if tau < -low else tau


@kernel
def motors(tau: Six, limit: Six, speed: Six, greatest: Six) -> Six:
    """Return the torques of six motors."""
    return (
        motor(tau[0], limit[0], speed[0], greatest[0]),
        motor(tau[1], limit[1], speed[1], greatest[1]),
        motor(tau[2], limit[2], speed[2], greatest[2]),
        motor(tau[3], limit[3], speed[3], greatest[3]),
        motor(tau[4], limit[4], speed[4], greatest[4]),
        motor(tau[5], limit[5], speed[5], greatest[5]),
    )


@kernel
def held(drive: Six, bias: Six, hold: Six) -> bool:
    """Return whether friction and brakes hold a standing arm against the torques on it."""
    return (
        -hold[0] <= drive[0] - bias[0] <= hold[0]
        and -hold[1] <= drive[1] - bias[1] <= hold[1]
        and -hold[2] <= drive[2] - bias[2] <= hold[2]
        and -hold[3] <= drive[3] - bias[3] <= hold[3]
        and -hold[4] <= drive[4] - bias[4] <= hold[4]
        and -hold[5] <= drive[5] - bias[5] <= hold[5]
    )


@kernel
def pushed(dt: float, speed: Six, inverse: Matrix, t: Six) -> Six:
    """Return the speeds (rad/s) after `dt` (s) under torques `t` (N m), by the inverse of the mass
    matrix."""
    t0, t1, t2, t3, t4, t5 = t
    v0, v1, v2, v3, v4, v5 = speed
    a, b, c, d, e, f = inverse[0]
    v0 += dt * (a * t0 + b * t1 + c * t2 + d * t3 + e * t4 + f * t5)
    a, b, c, d, e, f = inverse[1]
    v1 += dt * (a * t0 + b * t1 + c * t2 + d * t3 + e * t4 + f * t5)
    a, b, c, d, e, f = inverse[2]
    v2 += dt * (a * t0 + b * t1 + c * t2 + d * t3 + e * t4 + f * t5)
    a, b, c, d, e, f = inverse[3]
    v3 += dt * (a * t0 + b * t1 + c * t2 + d * t3 + e * t4 + f * t5)
    a, b, c, d, e, f = inverse[4]
    v4 += dt * (a * t0 + b * t1 + c * t2 + d * t3 + e * t4 + f * t5)
    a, b, c, d, e, f = inverse[5]
    v5 += dt * (a * t0 + b * t1 + c * t2 + d * t3 + e * t4 + f * t5)
    return v0, v1, v2, v3, v4, v5


@kernel
def _stopping(friction: float, speed: float, gain: float, hold: float) -> float:
    """Return the friction that stops a joint within the step, at most what friction can hold."""
    f = friction - speed / gain
    return hold if f > hold else -hold if f < -hold else f


@kernel
def rubbed(dt: float, speed: Six, inverse: Matrix, before: Six, hold: Six) -> tuple[Six, Six]:
    """Return the dry friction (N m) and the speeds that it leaves: the torque that would stop a
    joint within the step, at most `hold` (Coulomb friction as an impulse with a bound, as in
    time-stepping contact solvers).

    The friction of the last step, `before`, is the first guess (already in `speed`), so the
    coupling of the joints converges over a few steps. Where the guess was right, as it is while all
    joints slide, nothing changes.
    """
    friction = (
        _stopping(before[0], speed[0], dt * inverse[0][0], hold[0]),
        _stopping(before[1], speed[1], dt * inverse[1][1], hold[1]),
        _stopping(before[2], speed[2], dt * inverse[2][2], hold[2]),
        _stopping(before[3], speed[3], dt * inverse[3][3], hold[3]),
        _stopping(before[4], speed[4], dt * inverse[4][4], hold[4]),
        _stopping(before[5], speed[5], dt * inverse[5][5], hold[5]),
    )
    if friction == before:
        return friction, speed
    v0, v1, v2, v3, v4, v5 = speed
    for f, last, row in zip(friction, before, inverse):  # noqa: B905 - numba knows no strict zip
        if f != last:
            push = dt * (f - last)
            r0, r1, r2, r3, r4, r5 = row  # The matrix is symmetric: a row is a column.
            v0, v1, v2 = v0 + push * r0, v1 + push * r1, v2 + push * r2
            v3, v4, v5 = v3 + push * r3, v4 + push * r4, v5 + push * r5
    return friction, (v0, v1, v2, v3, v4, v5)


@kernel
def accelerated(
    dt: float,
    qd: Six,
    drive: Six,
    bias: Six,
    inverse: Matrix,
    viscous: Six,
    friction: Six,
    hold: Six,
) -> tuple[Six, Six]:
    """Return dry friction (N m) and speeds (rad/s) after `dt` (s).

    `drive`: the motors' torques; `bias`: those of gravity, Coriolis and centrifugal forces;
    `viscous` (N m s/rad); `friction`: that of the last step; `hold`: most that friction and brakes
    can hold.
    """
    torque = (
        drive[0] - bias[0] - viscous[0] * qd[0] + friction[0],
        drive[1] - bias[1] - viscous[1] * qd[1] + friction[1],
        drive[2] - bias[2] - viscous[2] * qd[2] + friction[2],
        drive[3] - bias[3] - viscous[3] * qd[3] + friction[3],
        drive[4] - bias[4] - viscous[4] * qd[4] + friction[4],
        drive[5] - bias[5] - viscous[5] * qd[5] + friction[5],
    )
    return rubbed(dt, pushed(dt, qd, inverse, torque), inverse, friction, hold)


@kernel
def _stopped(q: float, v: float, low: float, high: float) -> tuple[float, float]:
    return (low, 0.0) if q < low else (high, 0.0) if q > high else (q, v)


@kernel
def moved(dt: float, q: Six, speed: Six, lower: Six, upper: Six) -> tuple[Six, Six]:
    """Return angles (rad) and speeds after `dt` (s); a joint that reaches an end of its range stops
    there."""
    q0, v0 = _stopped(q[0] + dt * speed[0], speed[0], lower[0], upper[0])
    q1, v1 = _stopped(q[1] + dt * speed[1], speed[1], lower[1], upper[1])
    q2, v2 = _stopped(q[2] + dt * speed[2], speed[2], lower[2], upper[2])
    q3, v3 = _stopped(q[3] + dt * speed[3], speed[3], lower[3], upper[3])
    q4, v4 = _stopped(q[4] + dt * speed[4], speed[4], lower[4], upper[4])
    q5, v5 = _stopped(q[5] + dt * speed[5], speed[5], lower[5], upper[5])
    return (q0, q1, q2, q3, q4, q5), (v0, v1, v2, v3, v4, v5)


@kernel
def stepped(
    dt: float,
    q: Six,
    qd: Six,
    tau: Six,
    bias: Six,
    inverse: Matrix,
    friction: Six,
    limit: Six,
    greatest: Six,
    viscous: Six,
    hold: Six,
    stick: Six,
    lower: Six,
    upper: Six,
) -> tuple[Six, Six, Six, bool]:
    """Return angles, speeds and dry friction after `dt` (s), and whether the arm stands still from
    now on.

    `tau`: requested torques; `limit` (N m) and `greatest` (rad/s): those of the motors; `stick` (N
    m): what holds a joint at rest.
    """
    drive = motors(tau, limit, qd, greatest)
    friction, speed = accelerated(dt, qd, drive, bias, inverse, viscous, friction, hold)
    if max(speed) < STILL and min(speed) > -STILL and held(drive, bias, stick):
        return q, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), friction, True
    q, speed = moved(dt, q, speed, lower, upper)
    return q, speed, friction, False


@kernel
def _six(numbers: Sequence[float], first: int) -> Six:
    return (
        numbers[first],
        numbers[first + 1],
        numbers[first + 2],
        numbers[first + 3],
        numbers[first + 4],
        numbers[first + 5],
    )


@kernel
def _matrix(rows: Sequence[float]) -> Matrix:
    return (
        _six(rows, 0),
        _six(rows, 6),
        _six(rows, 12),
        _six(rows, 18),
        _six(rows, 24),
        _six(rows, 30),
    )


@kernel
def stepped_packed(
    dt: float,
    q: Six,
    qd: Six,
    tau: Six,
    bias: Six,
    friction: Six,
    inverse: Sequence[float],
    numbers: Sequence[float],
) -> tuple[Six, Six, Six, bool]:
    """Call `stepped` with packed arguments: the matrix row by row, then limit, greatest, viscous,
    hold, stick, lower and upper in one sequence. In compiled code, passing these as tuples takes as
    long as the step itself."""
    limit, greatest, viscous = _six(numbers, 0), _six(numbers, 6), _six(numbers, 12)
    hold, stick, lower, upper = (
        _six(numbers, 18),
        _six(numbers, 24),
        _six(numbers, 30),
        _six(numbers, 36),
    )
    matrix = _matrix(inverse)
    return stepped(
        dt, q, qd, tau, bias, matrix, friction, limit, greatest, viscous, hold, stick, lower, upper
    )


@kernel
def held_packed(tau: Six, speed: Six, bias: Six, numbers: Sequence[float]) -> bool:
    """Return whether friction and brakes hold a standing arm under the requested torques `tau`;
    `numbers` as in `stepped_packed`."""
    return held(motors(tau, _six(numbers, 0), speed, _six(numbers, 6)), bias, _six(numbers, 24))
