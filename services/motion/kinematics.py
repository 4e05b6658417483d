"""Forward and inverse kinematics of the PUMA 560 in closed form, and its geometric Jacobian; whole
batches at once.

Standard Denavit-Hartenberg convention with the signs of Paul and Zhang, "Computationally efficient
kinematics for manipulators with spherical wrists" (Int. J. Robotics Research 5(2), 1986). Frame 6
lies at the centre of the wrist. A joint pose is an array (..., 6) in radians, a pose a homogeneous
matrix (..., 4, 4) in metres.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.services.motion.model import ArmModel, Vector

SINGULAR = 1e-10
"""Sine of q5 below which the axes of joints 4 and 6 count as one line (wrist singularity)."""


class ArmBranch(NamedTuple):
    """One of the eight joint solutions of a pose, as three signs, each +1 or -1."""

    shoulder: int
    """+1: the wrist lies in front of the shoulder (in the direction that q1 points to); -1: the arm
    reaches back over the shoulder."""
    elbow: int
    """+1: the elbow lies above the line from shoulder to wrist; -1: below."""
    wrist: int
    """Sign of q5: +1 not flipped, -1 flipped."""


BRANCHES = tuple(ArmBranch(s, e, w) for s in (1, -1) for e in (1, -1) for w in (1, -1))


class Puma(Struct, frozen=True):
    """The arm's geometry for computation (m). `lower` and `upper` are the joint limits in radians,
    (6,) each."""

    d1: float
    a2: float
    a3: float
    d3: float
    d4: float
    lower: Vector
    upper: Vector

    @classmethod
    def of(cls, model: ArmModel) -> Puma:
        """Return the geometry of a model. Raises ValueError if the arm is not a PUMA (twists, zero
        lengths)."""
        twists = np.round(np.degrees(model.alpha), 9).tolist()
        zero = [*model.d[[1, 4, 5]], *model.a[[0, 3, 4, 5]]]
        if twists != [90.0, 0.0, -90.0, 90.0, -90.0, 0.0] or any(zero):
            raise ValueError(
                "closed-form kinematics needs a PUMA's twists (90, 0, -90, 90, -90, 0 "
                "degrees) and zero d2 d5 d6 a1 a4 a5 a6"
            )
        return cls(
            float(model.d[0]),
            float(model.a[1]),
            float(model.a[2]),
            float(model.d[2]),
            float(model.d[3]),
            model.lower,
            model.upper,
        )

    @property
    def forearm(self) -> float:
        """Distance from the elbow axis to the wrist's centre, both projected along the elbow's axis
        (m)."""
        return math.hypot(self.a3, self.d4)

    def forward(self, q: Vector) -> Vector:
        """Return poses of frame 6 for joint poses (..., 6): matrices (..., 4, 4), m."""
        q = np.asarray(q, dtype=float)
        c, s = np.cos(q), np.sin(q)
        c1, s1, c4, s4, c5, s5, c6, s6 = (
            c[..., 0],
            s[..., 0],
            c[..., 3],
            s[..., 3],
            c[..., 4],
            s[..., 4],
            c[..., 5],
            s[..., 5],
        )
        c23, s23 = np.cos(q[..., 1] + q[..., 2]), np.sin(q[..., 1] + q[..., 2])
        # Frame 6 seen from frame 3, column by column (x, y, z).
        wrist = (
            (c4 * c5 * c6 - s4 * s6, s4 * c5 * c6 + c4 * s6, s5 * c6),
            (-c4 * c5 * s6 - s4 * c6, -s4 * c5 * s6 + c4 * c6, -s5 * s6),
            (-c4 * s5, -s4 * s5, c5),
        )
        pose = np.zeros((*q.shape[:-1], 4, 4))
        for column, (x, y, z) in enumerate(wrist):
            radial, up = c23 * x - s23 * z, s23 * x + c23 * z
            pose[..., 0, column] = c1 * radial - s1 * y
            pose[..., 1, column] = s1 * radial + c1 * y
            pose[..., 2, column] = up
        reach = self.a2 * c[..., 1] + self.a3 * c23 - self.d4 * s23
        pose[..., 0, 3] = reach * c1 + self.d3 * s1
        pose[..., 1, 3] = reach * s1 - self.d3 * c1
        pose[..., 2, 3] = self.d1 + self.a2 * s[..., 1] + self.a3 * s23 + self.d4 * c23
        pose[..., 3, 3] = 1.0
        return pose

    def inverse(
        self, pose: Vector, branches: tuple[ArmBranch, ...] = BRANCHES, near: Vector | None = None
    ) -> Vector:
        """Return joint poses (..., len(branches), 6) of poses (..., 4, 4), in the order of
        `branches`.

        A solution that does not exist or breaks a joint limit is NaN. Where several turns of a
        joint fit its limits, the one closest to `near` (6,; default: the middle of the limits) is
        returned. Where q5 is 0, q4 is that of `near`.
        """
        pose = np.asarray(pose, dtype=float)
        near = 0.5 * (self.lower + self.upper) if near is None else np.asarray(near, dtype=float)
        signs = np.array(branches, dtype=float)
        q = np.empty((*pose.shape[:-2], len(branches), 6))
        with np.errstate(invalid="ignore"):
            self._solve_arm(pose[..., None, :3, 3], signs[:, 0], signs[:, 1], q)
            self._solve_wrist(pose[..., None, :3, :3], signs[:, 2], near[3], q)
            return self._within(q, near)

    def _solve_arm(self, p: Vector, shoulder: Vector, elbow: Vector, q: Vector) -> None:
        """Solve the first three joints from the wrist's centre (..., 1, 3)."""
        x, y, h = p[..., 0], p[..., 1], p[..., 2] - self.d1
        reach = shoulder * np.sqrt(x * x + y * y - self.d3 * self.d3)
        q[..., 0] = np.arctan2(y, x) + np.arctan2(self.d3, reach)
        length = self.forearm
        # Law of cosines in the triangle of shoulder, elbow and wrist centre; arccos gives NaN out
        # of reach.
        cosine = (reach * reach + h * h - self.a2 * self.a2 - length * length) / (
            2.0 * self.a2 * length
        )
        bend = -elbow * shoulder * np.arccos(cosine)
        q[..., 2] = bend - math.atan2(self.d4, self.a3)
        q[..., 1] = np.arctan2(h, reach) - np.arctan2(
            length * np.sin(bend), self.a2 + length * np.cos(bend)
        )

    def _solve_wrist(self, r: Vector, wrist: Vector, q4_if_singular: float, q: Vector) -> None:
        """Solve the last three joints from the orientation (..., 1, 3, 3) and the first three."""
        c1, s1 = np.cos(q[..., 0, None]), np.sin(q[..., 0, None])
        c23, s23 = (
            np.cos(q[..., 1] + q[..., 2])[..., None],
            np.sin(q[..., 1] + q[..., 2])[..., None],
        )
        forward = c1 * r[..., 0, :] + s1 * r[..., 1, :]
        m1 = c23 * forward + s23 * r[..., 2, :]
        m2 = c1 * r[..., 1, :] - s1 * r[..., 0, :]
        m3 = c23 * r[..., 2, :] - s23 * forward
        sine = wrist * np.hypot(m1[..., 2], m2[..., 2])
        singular = np.abs(sine) < SINGULAR
        q4 = np.where(
            singular, q4_if_singular, np.arctan2(-m2[..., 2] * wrist, -m1[..., 2] * wrist)
        )
        c4, s4 = np.cos(q4), np.sin(q4)
        q[..., 3] = q4
        q[..., 4] = np.arctan2(sine, m3[..., 2])
        # The y4 axis seen in frame 6 gives q6 even where q5 is 0.
        q[..., 5] = np.arctan2(c4 * m2[..., 0] - s4 * m1[..., 0], c4 * m2[..., 1] - s4 * m1[..., 1])

    def _within(self, q: Vector, near: Vector) -> Vector:
        """Choose turns of 2 pi such that each joint is within its limits, closest to `near`; NaN
        rows where none fits."""
        turn = 2.0 * math.pi
        q += turn * np.round((near - q) / turn)
        q += turn * (q < self.lower - LIMIT_SLACK)
        q -= turn * (q > self.upper + LIMIT_SLACK)
        good = ((q >= self.lower - LIMIT_SLACK) & (q <= self.upper + LIMIT_SLACK)).all(axis=-1)
        q[~good] = np.nan
        return q


LIMIT_SLACK = 1e-9
"""How far rounding may carry a solution beyond a joint limit (rad)."""


def branch_of(puma: Puma, q: NDArray[np.float64]) -> ArmBranch:
    """Return the branch on which a joint pose (6,) lies."""
    c23, s23 = math.cos(q[1] + q[2]), math.sin(q[1] + q[2])
    reach = puma.a2 * math.cos(q[1]) + puma.a3 * c23 - puma.d4 * s23
    shoulder = 1 if reach >= 0 else -1
    bend = math.sin(q[2] + math.atan2(puma.d4, puma.a3))
    return ArmBranch(shoulder, 1 if bend * shoulder <= 0 else -1, 1 if math.sin(q[4]) >= 0 else -1)
