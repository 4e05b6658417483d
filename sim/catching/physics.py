"""The seam between the laboratory and what computes its mechanics: two back ends, chosen by name.

`bullet` computes the arm's dynamics and the ball's contacts with PyBullet, `portable` with this
project's own code, which runs wherever Python and numpy do. Their results differ in the last digits
of the arm and in how exactly an impact is timed, so records of the two are never mixed: `version`
goes into every record (docs/physics.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version as installed
from importlib.util import find_spec
from typing import Any, Final, Protocol

from petrobot.sim.catching.arm_motion import Six
from petrobot.sim.catching.ball import BallModel, BallState
from petrobot.sim.catching.puma_model import Frame3, PrincipalInertia, PumaModel
from petrobot.sim.catching.truth import CupTruth, LaboratoryError, TableTruth, Vector

BULLET, PORTABLE = BACK_ENDS = ("bullet", "portable")
PORTABLE_VERSION: Final = 2
"""Counts up whenever the portable back end gives other results."""
TABLE_TOP: Final = 0.030
"""Thickness of the table top (m)."""


class ArmDynamics(Protocol):
    """Mass matrix and bias torques of the arm with its load, without rotors and friction."""

    def bias(self, q: Six, qd: Six) -> Six:
        """Return six torques (N m) that hold the arm against gravity, Coriolis and centrifugal
        forces at angles `q` (rad) and speeds `qd` (rad/s)."""

    def mass_matrix(self, q: Six) -> Vector:
        """Return the mass matrix (6, 6) kg m^2 at angles `q` (rad)."""

    def close(self) -> None:
        """Release what the back end holds."""


class BallContact(Protocol):
    """A ball that may touch table and cup, advanced in small steps. Everything in the base
    frame."""

    dt: float
    """Length of a step (s)."""

    def put_ball(self, state: BallState) -> None:
        """Set the ball's state."""

    def ball(self) -> BallState:
        """Return the ball's state."""

    def step(self, before: Frame3, after: Frame3) -> BallState:
        """Step by `dt` while the cup moves from `before` to `after` (origin: mouth centre, z out of
        the mouth)."""

    def close(self) -> None:
        """Release what the back end holds."""


def choose(name: str = "") -> str:
    """Return the back end of this name; empty: bullet where PyBullet is installed, else portable.
    Raises LaboratoryError for another name, or if PyBullet is asked for and missing."""
    there = find_spec("pybullet") is not None
    if not name:
        return BULLET if there else PORTABLE
    if name not in BACK_ENDS:
        raise LaboratoryError(
            f'physics: expected "{BULLET}" or "{PORTABLE}", got {name!r}; without the key it is '
            f'"{BULLET}" where PyBullet is installed'
        )
    if name == BULLET and not there:
        raise LaboratoryError(
            f'physics = "{BULLET}": PyBullet is not installed here (it has wheels for CPython 3.11 '
            f'on x86-64); install it, or write physics = "{PORTABLE}"'
        )
    return name


def version(name: str) -> str:
    """Return name and version of a back end, as records state them."""
    if name == PORTABLE:
        return f"{PORTABLE} {PORTABLE_VERSION}"
    try:
        return f"{BULLET} {installed('pybullet')}"
    except PackageNotFoundError:  # a build of one's own, on the path only
        return f"{BULLET} unknown"


def arm_dynamics(
    name: str, model: PumaModel, gravity: float, load: PrincipalInertia | None = None
) -> ArmDynamics:
    """Return the arm's dynamics by a back end; `load` is what the flange carries."""
    if name == BULLET:
        from petrobot.sim.catching.bullet import BulletArmDynamics

        return BulletArmDynamics(model, gravity, load)
    from petrobot.sim.catching.arm_dynamics import OwnArmDynamics

    return OwnArmDynamics(model, gravity, load)


def ball_contact(
    name: str,
    model: BallModel,
    table: TableTruth,
    cup: CupTruth,
    wall: float,
    settings: Mapping[str, Any],
) -> BallContact:
    """Return the ball's contacts by a back end. `wall`: thickness of the cup's wall and bottom (m);
    `settings`: the laboratory file."""
    if name == BULLET:
        from petrobot.sim.catching.bullet import BulletBallContact

        return BulletBallContact(model, table, cup, wall, settings)
    from petrobot.sim.catching.ball_contact import OwnBallContact

    return OwnBallContact(model, table, cup, wall, settings)
