"""Where to catch: from a predicted exit over the table's edge to a joint pose that has the cup
there in time. Pure.

The ball leaves the edge and falls along a parabola. Candidates are laid out along its fall: each is
a depth below the edge and a turn of the hand about the cup's axis, which leaves the cup in place
but uses other joints. All candidates are solved and timed at once, on one branch of the inverse
kinematics, and the cheapest is taken: in time first, then quickly reached, near the preferred
depth, mouth open to the ball. The earlier choice keeps a bonus, so that a small change of the
prediction moves the pose a little instead of jumping to another candidate. docs/motion.md says how
depths and tilt were chosen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from petrobot.services.device import Setpoint
from petrobot.services.motion.kinematics import ArmBranch, Puma
from petrobot.services.motion.limits import CollisionGuard
from petrobot.services.motion.model import CatchingCell, Vector
from petrobot.services.motion.trajectory import Trajectory, reach_time

STREAM_LENGTH: Final = 9
"""Number of values in a set point of `catch_point`: time_to_go, x, y, z, vx, vy, vz, sigma_y,
sigma_t."""


LARGEST: Final = 1000.0
"""s, m or m/s above which a number cannot belong to a catch point of any laboratory; rejects NaN
and infinity too."""
SLOWEST: Final = 1e-3
"""Speed towards the arm below which the ball does not arrive (m/s)."""


class Prediction(Struct, frozen=True):
    """Where (m), when (s from now) and how fast (m/s) the ball's centre leaves the table's near
    edge; base frame."""

    time_to_go: float
    point: tuple[float, float, float]
    velocity: tuple[float, float, float]
    sigma_y: float
    sigma_t: float

    @classmethod
    def parse(cls, values: Sequence[float], age: float = 0.0) -> Prediction:
        """Read a set point that arrived `age` seconds ago. Raises ValueError if it is malformed or
        moves away from the arm."""
        if len(values) != STREAM_LENGTH or not all(abs(value) <= LARGEST for value in values):
            raise ValueError(
                f"catch point: expected {STREAM_LENGTH} numbers of at most {LARGEST:g}, got "
                f"{list(values)}"
            )
        go, x, y, z, vx, vy, vz, sigma_y, sigma_t = (float(value) for value in values)
        if vx > -SLOWEST or sigma_y < 0.0 or sigma_t < 0.0:
            raise ValueError(
                f"catch point: expected vx <= -{SLOWEST:g} m/s and sigmas >= 0, got vx = {vx}, "
                f"sigmas {sigma_y}, {sigma_t}"
            )
        return cls(go - age, (x, y, z), (vx, vy, vz), sigma_y, sigma_t)

    def shrunk(self) -> Prediction:
        """Weigh the prediction against a prior of y = 0 +- `PRIOR_SPREAD`.

        The mean of two Gaussians: a coarse prediction moves the arm only a part of the way.
        """
        prior = PRIOR_SPREAD * PRIOR_SPREAD
        weight = prior / (prior + self.sigma_y * self.sigma_y)
        x, y, z = self.point
        vx, vy, vz = self.velocity
        return replace(self, point=(x, y * weight, z), velocity=(vx, vy * weight, vz))


class Strategy(Struct, frozen=True):
    """How to hold the cup.

    `tilt` of its axis from the vertical against the ball (rad); `depths` below the exit at which to
    catch (m), and the `preferred` one; `opening`: least cosine between the cup's axis and the
    ball's path at which the mouth counts as open; `hands`: turns of the hand about the cup's axis
    (rad).
    """

    tilt: float
    depths: tuple[float, ...]
    preferred: float
    opening: float
    hands: tuple[float, ...] = tuple(math.radians(angle) for angle in range(-90, 91, 18))
    margin: float = 0.03
    """Seconds by which the arm should arrive before the ball: the drives lag and settle."""


STRATEGIES: Final = {
    "tilted": Strategy(
        math.radians(30.0), (0.045, 0.055, 0.065, 0.08, 0.10, 0.13, 0.17, 0.21), 0.055, 0.70
    ),
    "upright": Strategy(0.0, (0.08, 0.11, 0.14, 0.17, 0.20, 0.24, 0.28), 0.11, 0.72),
}
"""By name: `tilted` receives the ball head-on just below the edge, `upright` lets it fall into a
level cup further down."""

PRIOR_SPREAD: Final = 0.17
"""m, standard deviation of where balls leave: uniform within +-0.30 m, so 0.30 / sqrt(3)."""
DEPTH_COST: Final = 2.0
"""Price of a metre from the preferred depth (s)."""
CLOSED_COST: Final = 4.0
"""Price of the cosine by which the mouth is less open to the ball than it should be (s)."""
RETREAT: Final = 0.08
"""m back from a catching pose to the pose from which it is approached where the straight path is
not clear."""
LATE_COST: Final = 20.0
"""Weight of each second too late."""
EARLY: Final = 0.05
"""Slack below which time costs more (s)."""
HASTE: Final = 0.05
"""Duration of a motion from which the full margin is required (s)."""
KEEP: Final = 0.03
"""Cost by which another candidate must be better than the present one."""


class CatchPlan(Struct, frozen=True):
    """A catching pose. Times are seconds from when the plan was made; `slack` is the time left
    over, negative if late."""

    q: tuple[float, ...]
    point: tuple[float, float, float]
    axis: tuple[float, float, float]
    arrival: float
    reach: float
    slack: float
    candidate: int


class Interceptor:
    """Chooses catching poses for one arm and cup. One `plan` costs about as much as ten cycles of
    the driver, so make one per prediction."""

    def __init__(
        self,
        puma: Puma,
        cell: CatchingCell,
        guard: CollisionGuard,
        home: Sequence[float],
        branch: ArmBranch,
    ) -> None:
        self._puma = puma
        self._cell = cell
        self._guard = guard
        self._branch = branch
        self._home = np.asarray(home, dtype=float)
        self._mouth = np.asarray(cell.cup.mouth)
        self._layouts: dict[Strategy, _Layout] = {}
        axis = np.asarray(cell.cup.axis)
        outward = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
        if np.linalg.norm(outward) < 0.1:
            raise ValueError(
                "cell.toml: cup.axis: expected an axis across the flange's axis z6, got one along "
                "it: turning the hand would not change anything; mount the cup sideways"
            )
        outward /= np.linalg.norm(outward)
        self._mount = np.column_stack([axis, outward, np.cross(axis, outward)])

    def plan(
        self,
        strategy: Strategy,
        prediction: Prediction,
        q: Sequence[float],
        qd: Sequence[float],
        speed: Sequence[float],
        acceleration: Sequence[float],
        before: CatchPlan | None = None,
    ) -> CatchPlan | None:
        """Return the best catching pose from the arm's state and limits (rad, rad/s, rad/s^2); None
        if no candidate can be reached."""
        prediction = prediction.shrunk()
        layout = self._layout(strategy)
        axis = _against(prediction.velocity, strategy.tilt)
        fall = np.array(self._fall(strategy, prediction, axis))
        points = fall[:, :3]
        solved = self._puma.inverse(
            self._poses(points, axis, layout), (self._branch,), near=self._home
        )[:, 0]
        times = reach_time(
            solved - np.asarray(q), np.asarray(qd), np.asarray(speed), np.asarray(acceleration)
        ).max(axis=1)
        hands = layout.hands
        arrival = prediction.time_to_go + np.repeat(fall[:, 3], hands)
        haste = np.minimum(times / HASTE, 1.0)  # A cup that is already in place needs no margin.
        slack = arrival - strategy.margin * haste - times
        closed = CLOSED_COST * np.repeat(np.maximum(strategy.opening - fall[:, 4], 0.0), hands)
        late = LATE_COST * np.maximum(-slack, 0.0) + haste * np.maximum(EARLY - slack, 0.0)
        cost = times + layout.off_depth + closed + late
        cost[np.isnan(cost)] = np.inf
        if before is not None and before.candidate < len(cost):
            cost[before.candidate] -= KEEP
        for index in np.argsort(cost).tolist():
            if not math.isfinite(cost[index]):
                return None
            pose = tuple(solved[index].tolist())
            if not self._guard.violation(pose):
                x, y, z = points[index // hands].tolist()
                when = float(arrival[index]), float(times[index]), float(slack[index])
                return CatchPlan(pose, (x, y, z), _triple(axis), *when, index)
        return None

    def retreat(self, q: Sequence[float]) -> tuple[float, ...] | None:
        """Return the pose that holds the cup as in a joint pose but further from the table; None if
        it is not clear."""
        pose = self._puma.forward(np.asarray(q))
        pose[0, 3] -= RETREAT
        back: list[float] = self._puma.inverse(pose, (self._branch,), near=np.asarray(q))[
            0
        ].tolist()
        return tuple(back) if math.isfinite(back[0]) and not self._guard.violation(back) else None

    def _layout(self, strategy: Strategy) -> _Layout:
        if strategy not in self._layouts:
            self._layouts = {strategy: _Layout(strategy)}  # Only one strategy is in use at a time.
        return self._layouts[strategy]

    def _fall(
        self, strategy: Strategy, prediction: Prediction, axis: Vector
    ) -> list[tuple[float, ...]]:
        """Return for each depth of the strategy: the point of the parabola (x, y, z; m), the time
        after the edge (s), and the cosine between the cup's axis and the direction that the ball
        comes from."""
        gravity, (x, y, z), (vx, vy, vz) = self._cell.gravity, prediction.point, prediction.velocity
        ax, ay, az = axis.tolist()
        fall: list[tuple[float, ...]] = []
        for depth in strategy.depths:
            t = (vz + math.sqrt(vz * vz + 2.0 * gravity * depth)) / gravity
            w = vz - gravity * t
            opening = -(ax * vx + ay * vy + az * w) / math.sqrt(vx * vx + vy * vy + w * w)
            fall.append((x + vx * t, y + vy * t, z - depth, t, opening))
        return fall

    def _poses(self, points: Vector, axis: Vector, layout: _Layout) -> Vector:
        """Return poses (n * hands, 4, 4) of frame 6 with the cup's mouth at the points and its axis
        as given, in all turns of the hand."""
        ahead = np.array([1.0, 0.0, 0.0]) - axis[0] * axis
        ahead /= math.sqrt(float(ahead @ ahead))
        x, y, z = axis.tolist()
        side = np.array(
            [y * ahead[2] - z * ahead[1], z * ahead[0] - x * ahead[2], x * ahead[1] - y * ahead[0]]
        )
        frames = layout.frames
        frames[:, :, 0] = axis
        frames[:, :, 1] = layout.cosine * ahead + layout.sine * side
        frames[:, :, 2] = layout.cosine * side - layout.sine * ahead
        rotations = frames @ self._mount.T
        poses = layout.poses
        poses[..., :3, :3] = rotations
        poses[..., :3, 3] = points[:, None] - rotations @ self._mouth
        return poses.reshape(-1, 4, 4)


class _Layout:
    """Arrays of a strategy's candidates that do not depend on the prediction, and buffers for those
    that do."""

    def __init__(self, strategy: Strategy) -> None:
        turns = np.asarray(strategy.hands)
        self.hands = len(turns)
        self.cosine, self.sine = np.cos(turns)[:, None], np.sin(turns)[:, None]
        self.off_depth = np.repeat(
            DEPTH_COST * np.abs(np.asarray(strategy.depths) - strategy.preferred), self.hands
        )
        self.frames = np.empty((self.hands, 3, 3))
        self.poses = np.zeros((len(strategy.depths), self.hands, 4, 4))
        self.poses[..., 3, 3] = 1.0


def _triple(vector: Vector) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z


def _against(velocity: tuple[float, float, float], tilt: float) -> Vector:
    """Return the unit vector tilted from the vertical towards where the ball comes from."""
    speed = math.hypot(velocity[0], velocity[1])
    share = math.sin(tilt) / speed if speed > 0.0 else 0.0
    return np.array([-velocity[0] * share, -velocity[1] * share, math.cos(tilt)])


# --- following a stream of predictions ---

STALE_PERIODS: Final = 3
"""Periods of the stream after which a set point must not be executed any more."""
FROZEN: Final = 0.03
"""Seconds before the ball arrives from which the cup keeps still: a late correction gains less than
a moving rim can spoil."""
SAME_PLACE: Final = 0.0003
"""m, `SAME_SPEED` m/s, `SAME_TIME` s: by how much two predictions may differ and still share one
plan; 0.5 mm at the cup."""
SAME_SPEED: Final = 0.002
SAME_TIME: Final = 0.002
SAME_SIGMA: Final = 0.002
ROUNDING: Final = 1e-9
"""Seconds by which rounding may change an age."""


class Follower:
    """The newest prediction of the stream, and the plan for it."""

    def __init__(self, period: float) -> None:
        self._period = period
        self.strategy: Strategy = STRATEGIES["tilted"]
        self.plan: CatchPlan | None = None
        self._made = 0.0
        self._prediction: Prediction | None = None
        self._planned: Prediction | None = None
        self._planned_for = self.strategy
        self._values: tuple[float, ...] | None = None
        self.count = 0
        self.age = math.inf
        self._came = -math.inf
        self.refused = 0
        self.oldest = 0.0
        self.stale = 0

    def begin(self, count: int) -> None:
        """Forget the past: only set points that arrive from now on count."""
        self.plan, self._prediction, self._values = None, None, None
        self.count, self.age, self._came = count, math.inf, -math.inf

    def fresh(self, now: float) -> bool:
        """Return whether the last valid set point may still be executed; store its age."""
        self.age = now - self._came
        return self.age <= STALE_PERIODS * self._period + ROUNDING

    def executed(self, now: float) -> None:
        """Record that a cycle moved towards the last valid set point; its age is recorded
        separately from the rule that decides about it."""
        age = now - self._came
        self.oldest = max(self.oldest, age)
        self.stale += age > STALE_PERIODS * self._period + ROUNDING

    def take(self, setpoint: Setpoint, now: float) -> bool:
        """Accept a set point with new values if it may be executed; a repetition only renews the
        last one."""
        values = setpoint.values
        if setpoint.count == self.count or values is None:
            return False
        self.count = setpoint.count
        if values != self._values:
            try:
                self._prediction = Prediction.parse(values, setpoint.held)
            except ValueError:
                self.refused += 1
                return False
        self._came = now - setpoint.age
        new, self._values = values != self._values, values
        return self.fresh(now) and new

    def drop(self) -> None:
        """Treat the values of the stale set point as new if they arrive again."""
        self._values = None

    def plan_with(
        self,
        interceptor: Interceptor,
        trajectory: Trajectory,
        speed: Sequence[float],
        acceleration: Sequence[float],
        now: float,
    ) -> CatchPlan | None:
        """Plan for the prediction just accepted; return None if it cannot be reached (then the
        earlier plan is forgotten)."""
        assert self._prediction is not None
        if self.plan is not None and (
            self.plan.arrival - (now - self._made) < FROZEN or self._says_the_same(now)
        ):
            return self.plan
        self.plan = interceptor.plan(
            self.strategy,
            self._prediction,
            trajectory.q,
            trajectory.qd,
            speed,
            acceleration,
            self.plan,
        )
        self._made, self._planned, self._planned_for = now, self._prediction, self.strategy
        return self.plan

    def _says_the_same(self, now: float) -> bool:
        """Return whether the newest prediction differs too little from the planned one to be worth
        a new plan."""
        new, old = self._prediction, self._planned
        if new is None or old is None or self.strategy != self._planned_for:
            return False
        apart = max(abs(a - b) for a, b in zip(new.point, old.point, strict=True))
        faster = max(abs(a - b) for a, b in zip(new.velocity, old.velocity, strict=True))
        later = abs(new.time_to_go + now - old.time_to_go - self._made)
        surer = old.sigma_y - new.sigma_y
        return (
            apart < SAME_PLACE and faster < SAME_SPEED and later < SAME_TIME and surer < SAME_SIGMA
        )

    def published(self, now: float) -> dict[str, Any] | None:
        """Return the plan as plain data; times are seconds from `now`."""
        plan, prediction = self.plan, self._prediction
        if plan is None or prediction is None:
            return None
        return {
            "point": plan.point,
            "axis": plan.axis,
            "arrival": plan.arrival - (now - self._made),
            "slack": plan.slack,
            "reach": plan.reach,
            "sigma_y": prediction.sigma_y,
            "sigma_t": prediction.sigma_t,
        }
