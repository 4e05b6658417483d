"""The arm as a body that torques move: rigid-body dynamics, rotors, friction, brakes, hard stops.

Mass matrix and bias torques come from the back end (sim/catching/physics.py) with the published
values; rotor inertia (up to 2.3 kg m^2 at the joint, more than most links) is added here. The
integration is semi-implicit Euler. An arm that stands still, held by friction or brakes, costs
almost nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from petrobot.services.host.numba_kernels import packed
from petrobot.sim.catching.arm_motion import (
    Matrix,
    Six,
    held,
    held_packed,
    motors,
    stepped,
    stepped_packed,
)
from petrobot.sim.catching.physics import arm_dynamics, choose
from petrobot.sim.catching.puma_model import JOINTS, PrincipalInertia, PumaModel

_REFRESH = (0.01, 0.01, 0.1, 0.1)
"""rad, of joints 2 to 5; the mass matrix is computed again when a joint has moved so far, which
changes it by less than 1 %. It does not depend on joint 1, and on the wrist only through light
links."""
_STICTION = 1.05
"""Dry friction of a joint at rest as a multiple of that of a moving joint: the joint sticks where
sliding fades."""
_REST: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_BRAKE = 2.0
"""Torque of a joint's brake as a multiple of the motor's."""


class ArmPlant:
    """The arm as its drives see it: six torques in, six positions and speeds out.

    `q` (rad) and `qd` (rad/s) are what the encoders show. Drives write torques (N m at the joint)
    to `tau` and engage or release brakes; `step` moves the arm. Plain floats, since six numbers are
    too few for an array to be faster (11 us a step against 30).
    """

    def __init__(
        self,
        model: PumaModel,
        gravity: float,
        start: Sequence[float],
        load: PrincipalInertia | None = None,
        physics: str = "",
    ) -> None:
        """`load`: what the flange carries; `physics`: as for `physics.choose`."""
        self.model = model
        self.q: Six = _six(start)
        self.qd: Six = _REST
        self.tau: list[float] = [0.0] * JOINTS
        self.moves = 0
        """Counts the steps in which the arm moved: unchanged means that the pose is unchanged."""
        self.still = True
        """Whether no joint moves."""
        self._body = arm_dynamics(choose(physics), model, gravity, load)
        self._rotors = np.diag(model.rotor)
        self._limit, self._viscous = _six(model.torque), _six(model.viscous)
        self._dry: list[float] = model.coulomb.tolist()
        self._ends = _six(model.lower), _six(model.upper)
        self.braked = [True] * JOINTS
        """Which brakes are engaged."""
        self._hold = self._stick = _REST
        self._greatest = _six(model.speed)
        self._packs = hasattr(stepped_packed, "py_func")
        """Whether kernels are compiled: then they receive what seldom changes in packed form, else
        as tuples."""
        for joint in range(JOINTS):
            self.brake(joint)
        self._friction = _REST
        self._bias = self._body.bias(self.q, self.qd)
        self.slow_down(1.0)
        self._refresh()
        self._warm_up()

    def _warm_up(self) -> None:
        """Compile the kernels, or load them from the cache, now and not when the arm first
        moves."""
        self._held(_REST)
        self._stepped(0.001, _REST, self._bias)

    def brake(self, joint: int) -> None:
        """Engage the brake of a joint (0 to 5) and switch its torque off."""
        self.tau[joint] = 0.0
        self.braked[joint] = True
        hold = self._dry[joint] + _BRAKE * self._limit[joint]
        self._hold, self._stick = _put(self._hold, joint, hold), _put(self._stick, joint, hold)
        self._pack()

    def release(self, joint: int) -> None:
        """Release the brake of a joint (0 to 5)."""
        self.braked[joint] = False
        self._hold = _put(self._hold, joint, self._dry[joint])
        self._stick = _put(self._stick, joint, _STICTION * self._dry[joint])
        self._pack()

    def slow_down(self, factor: float) -> None:
        """Limit the joints to this share (0 to 1] of their greatest speeds from now on."""
        if not 0.0 < factor <= 1.0:
            raise ValueError(f"speed factor: expected a number above 0 and at most 1, got {factor}")
        self._greatest = _six(self.model.speed * factor)
        self._pack()

    def _pack(self) -> None:
        """Pack the numbers that compiled kernels read, after one has changed."""
        if self._packs:
            groups = (
                self._limit,
                self._greatest,
                self._viscous,
                self._hold,
                self._stick,
                *self._ends,
            )
            self._numbers = packed(stepped_packed, [number for group in groups for number in group])

    def step(self, dt: float, tau: Sequence[float] | None = None) -> None:
        """Advance by `dt` (s) under torques `tau` (six, N m), those in `self.tau` if None."""
        if tau is not None:
            self.tau[:] = tau
        a, b, c, d, e, f = self.tau
        asked = a, b, c, d, e, f
        if self.still and self._held(asked):
            return
        if not self._near(self.q):
            self._refresh()
        self._bias = bias = self._body.bias(self.q, self.qd)
        self.moves += 1
        self.q, self.qd, self._friction, self.still = self._stepped(dt, asked, bias)

    def _held(self, asked: Six) -> bool:
        """Return whether friction and brakes hold the standing arm under these torques."""
        if self._packs:
            return held_packed(asked, self.qd, self._bias, self._numbers)
        return held(motors(asked, self._limit, self.qd, self._greatest), self._bias, self._stick)

    def _stepped(self, dt: float, asked: Six, bias: Six) -> tuple[Six, Six, Six, bool]:
        """Return angles, speeds and dry friction after `dt`, and whether the arm then stands
        still."""
        if self._packs:
            return stepped_packed(
                dt, self.q, self.qd, asked, bias, self._friction, self._rows, self._numbers
            )
        return stepped(
            dt,
            self.q,
            self.qd,
            asked,
            bias,
            self._inverse,
            self._friction,
            self._limit,
            self._greatest,
            self._viscous,
            self._hold,
            self._stick,
            *self._ends,
        )

    def _near(self, q: Six) -> bool:
        """Return whether the mass matrix is still accurate enough."""
        _, a, b, c, d, _ = self._at
        u, v, w, x = _REFRESH
        return -u < q[1] - a < u and -v < q[2] - b < v and -w < q[3] - c < w and -x < q[4] - d < x

    def _refresh(self) -> None:
        inverse = np.linalg.inv(self._body.mass_matrix(self.q) + self._rotors)
        if self._packs:
            self._rows: Any = inverse.ravel()
        else:
            a, b, c, d, e, f = map(_six, inverse.tolist())
            self._inverse: Matrix = a, b, c, d, e, f
        self._at = self.q

    def close(self) -> None:
        """Release what the back end holds."""
        self._body.close()


def _six(values: Iterable[float]) -> Six:
    a, b, c, d, e, f = map(float, values)
    return a, b, c, d, e, f


def _put(values: Six, joint: int, value: float) -> Six:
    """The same with another value at one joint."""
    return _six((*values[:joint], value, *values[joint + 1 :]))
