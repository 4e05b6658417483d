"""The arm against published values, against mechanics independent of both back ends, and the back
ends against each other."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from msgspec.structs import replace

from petrobot.services.host.numba_kernels import packed, plain
from petrobot.sim.catching.arm_dynamics import (
    OwnArmDynamics,
    general_torques,
    is_puma,
    mass_numbers,
    puma_bias,
    regrouped,
)
from petrobot.sim.catching.arm_motion import Six
from petrobot.sim.catching.drives import JointServo
from petrobot.sim.catching.physics import BULLET, ArmDynamics, arm_dynamics
from petrobot.sim.catching.puma import ArmPlant
from petrobot.sim.catching.puma_model import PrincipalInertia, PumaModel
from petrobot.sim.catching.site import Site
from petrobot.sim.catching.truth import Vector
from tests.sim.conftest import needs_bullet

GRAVITY = 9.81
ANGLES = st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6)
"""Joint angles as fractions of the range from the middle of the limits to their ends."""


@pytest.fixture(scope="module")
def body(arm: PumaModel, physics: str) -> ArmDynamics:
    return arm_dynamics(physics, arm, GRAVITY)


def six(values: Iterable[float]) -> Six:
    a, b, c, d, e, f = map(float, values)
    return a, b, c, d, e, f


def angles(arm: PumaModel, shares: list[float]) -> Six:
    middle, half = (arm.lower + arm.upper) / 2, (arm.upper - arm.lower) / 2
    return six(middle + half * np.array(shares))


def potential_energy(arm: PumaModel, q: Sequence[float]) -> float:
    """Return the potential energy (J) from masses and heights alone."""
    frames = arm.frames(q)
    return sum(
        GRAVITY * link.mass * frame.point(link.centre)[2]
        for link, frame in zip(arm.links, frames[1:], strict=True)
    )


def without_friction(arm: PumaModel) -> PumaModel:
    return replace(arm, viscous=np.zeros(6), coulomb=np.zeros(6))


# The Robotics Toolbox's documentation prints these for its Puma560 (kinematics without the
# pedestal).
QZ: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
QN: Six = (0.0, math.pi / 4, math.pi, 0.0, math.pi / 4, 0.0)


@pytest.mark.parametrize(
    ("q", "torques"),
    [(QZ, [0, 37.4837, 0.2489, 0, 0, 0]), (QN, [0, 31.6399, 6.0351, 0, 0.0283, 0])],
)
def test_gravity_equals_the_published_values(
    body: ArmDynamics, q: Six, torques: list[float]
) -> None:
    assert body.bias(q, QZ) == pytest.approx(torques, abs=1e-4)


def test_the_mass_matrix_equals_the_published_one(arm: PumaModel, body: ArmDynamics) -> None:
    published = [
        [3.6594, -0.4044, 0.1006, -0.0025, 0.0, 0.0],
        [-0.4044, 4.4137, 0.3509, 0.0, 0.0024, 0.0],
        [0.1006, 0.3509, 0.9378, 0.0, 0.0015, 0.0],
        [-0.0025, 0.0, 0.0, 0.1925, 0.0, 0.0],
        [0.0, 0.0024, 0.0015, 0.0, 0.1713, 0.0],
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.1941],
    ]
    mass = body.mass_matrix(QN) + np.diag(arm.rotor)
    # link 3's published tensor is no real body's; mending it moves the inertia about joint 1 by
    # 0.004 kg m^2
    assert mass == pytest.approx(np.array(published), abs=4.1e-3)
    assert mass[1:, 1:] == pytest.approx(np.array(published)[1:, 1:], abs=1e-3)


def test_the_zero_pose_equals_the_published_one(arm: PumaModel) -> None:
    assert arm.frames(QZ)[6].origin == pytest.approx((0.4521, -0.15005, 0.4318 + 0.67183))


@needs_bullet
@settings(max_examples=60, deadline=None)
@given(shares=ANGLES)
def test_forward_kinematics_agrees_with_bullet(arm: PumaModel, shares: list[float]) -> None:
    from petrobot.sim.catching.bullet import BulletArmDynamics

    q, body = angles(arm, shares), BulletArmDynamics(arm, GRAVITY)
    flange = arm.frames(q)[6]
    origin, rotation = body.link_frame(
        q, 5
    )  # frame 6 coincides with its URDF link: d6, a6 and alpha6 are zero
    body.close()
    assert flange.origin == pytest.approx(origin, abs=1e-6)
    assert flange.rotation() == pytest.approx(rotation, abs=2e-6)


LOAD = PrincipalInertia(0.08, (0.01, 0.09, 0.05), (1.1e-4, 2.0e-4, 1.5e-4))


def any_arm(arm: PumaModel, rng: np.random.Generator) -> PumaModel:
    """Draw an arm with random lengths, twists, masses, centres and inertias, none of them zero."""
    alpha = rng.uniform(-3.0, 3.0, 6).tolist()
    return replace(
        arm,
        d=tuple(rng.uniform(-0.5, 0.5, 6).tolist()),
        a=tuple(rng.uniform(-0.5, 0.5, 6).tolist()),
        alpha=tuple(alpha),
        twists=tuple((math.cos(angle), math.sin(angle)) for angle in alpha),
        links=tuple(
            PrincipalInertia(
                rng.uniform(0.1, 20.0), tuple(rng.uniform(-0.3, 0.3, 3).tolist()), tuple(inertia)
            )
            for inertia in rng.uniform(0.3, 0.5, (6, 3)).tolist()
        ),
    )


@pytest.mark.once
@needs_bullet
@pytest.mark.parametrize("case", ["bare", "loaded", *range(6)])
def test_the_back_ends_agree_on_the_arm(arm: PumaModel, case: str | int) -> None:
    """Tried with the shipped arm without and with its cup, and with arms without any zero; 1,000
    states each, equal to 1e-12 of the largest torque (N m) and inertia (kg m^2)."""
    rng = np.random.default_rng(7)
    if isinstance(case, int):
        rng = np.random.default_rng(case)
        arm = any_arm(arm, rng)
    load = LOAD if case == "loaded" else None
    bullet, own = arm_dynamics(BULLET, arm, GRAVITY, load), OwnArmDynamics(arm, GRAVITY, load)
    for _ in range(1000):
        q, qd = sixes(rng, 3.2), sixes(rng, 4.0)
        bias, mass = np.array(bullet.bias(q, qd)), bullet.mass_matrix(q)
        assert np.abs(own.bias(q, qd) - bias).max() <= 1e-12 * max(1.0, np.abs(bias).max())
        assert np.abs(own.mass_matrix(q) - mass).max() <= 1e-12 * max(1.0, np.abs(mass).max())
    bullet.close()


def sixes(rng: np.random.Generator, most: float) -> Six:
    return six(rng.uniform(-most, most, 6))


def any_puma(arm: PumaModel, rng: np.random.Generator) -> PumaModel:
    """Draw an arm with the geometry of a PUMA and random other numbers, none of them zero."""
    drawn = any_arm(arm, rng)
    d, a = drawn.d, drawn.a
    return replace(
        drawn,
        d=(d[0], 0.0, d[2], d[3], 0.0, 0.0),
        a=(0.0, a[1], a[2], 0.0, 0.0, 0.0),
        alpha=arm.alpha,
        twists=arm.twists,
    )


@pytest.mark.once
@pytest.mark.parametrize("case", range(6))
def test_the_algorithms_without_zero_terms_agree_with_the_general_ones(
    arm: PumaModel, case: int
) -> None:
    """The shipped arm (case 0), arms with the geometry of a PUMA (1, 2), any arms: bias and mass
    matrix equal the general recursion within 1e-12; plain and compiled code equal to the bit."""
    rng = np.random.default_rng(case)
    if case:
        arm = (any_puma if case < 3 else any_arm)(arm, rng)
    numbers, own = regrouped(arm, LOAD), OwnArmDynamics(arm, GRAVITY, LOAD)
    assert is_puma(numbers) == (case < 3)
    kept = packed(puma_bias, numbers)
    for _ in range(100):
        q, qd = sixes(rng, 3.2), sixes(rng, 4.0)
        bias = np.array(general_torques(q, qd, QZ, GRAVITY, numbers))
        assert np.abs(own.bias(q, qd) - bias).max() <= 1e-12 * max(1.0, np.abs(bias).max())
        mass = own.mass_matrix(q)
        columns = [general_torques(q, QZ, six(unit), 0.0, numbers) for unit in np.eye(6)]
        assert np.abs(mass - columns).max() <= 1e-12 * max(1.0, np.abs(mass).max())
        if is_puma(numbers):
            assert plain(puma_bias)(q, qd, GRAVITY, kept) == puma_bias(q, qd, GRAVITY, kept)
        assert plain(mass_numbers)(q, kept) == mass_numbers(q, kept)


@settings(max_examples=40, deadline=None)
@given(shares=ANGLES)
def test_gravity_is_the_gradient_of_the_potential_energy(
    arm: PumaModel, body: ArmDynamics, shares: list[float]
) -> None:
    q, step = angles(arm, shares), 1e-5
    gradient = []
    for joint in range(6):
        up, down = list(q), list(q)
        up[joint] += step
        down[joint] -= step
        gradient.append((potential_energy(arm, up) - potential_energy(arm, down)) / (2 * step))
    assert body.bias(q, QZ) == pytest.approx(gradient, abs=1e-6)


@settings(max_examples=40, deadline=None)
@given(shares=ANGLES)
def test_mass_matrix_is_symmetric_and_positive(
    arm: PumaModel, body: ArmDynamics, shares: list[float]
) -> None:
    mass = body.mass_matrix(angles(arm, shares))
    assert mass == pytest.approx(mass.T, abs=1e-12)
    assert np.linalg.eigvalsh(mass + np.diag(arm.rotor)).min() > 0.1


def test_every_published_tensor_counts(arm: PumaModel, body: ArmDynamics, physics: str) -> None:
    """Bullet silently sets an impossible tensor to zero, so the inertia about each joint is
    checked."""
    links = tuple(
        PrincipalInertia(n.mass, n.centre, (2 * n.inertia[0], 2 * n.inertia[1], 2 * n.inertia[2]))
        for n in arm.links
    )
    difference = arm_dynamics(physics, replace(arm, links=links), GRAVITY).mass_matrix(
        QN
    ) - body.mass_matrix(QN)
    assert difference[0, 0] > 0.35  # link 1's own 0.35 alone
    assert difference[2, 2] == pytest.approx(
        arm.links[2].inertia[1] + 1.3e-3 + 0.4e-3 + 0.15e-3, abs=6e-4
    )


@needs_bullet
def test_urdf_names_all_six_joints(arm: PumaModel) -> None:
    from petrobot.sim.catching.bullet import urdf

    text = urdf(arm)
    assert [text.count(f'name="joint{n}"') for n in range(1, 7)] == [1] * 6


def released(
    physics: str, arm: PumaModel, q: Sequence[float], joints: range = range(6)
) -> ArmPlant:
    plant = ArmPlant(arm, GRAVITY, q, physics=physics)
    for joint in joints:
        plant.release(joint)
    return plant


def test_energy_is_conserved_without_friction(arm: PumaModel, physics: str) -> None:
    free = without_friction(arm)
    body, start = arm_dynamics(physics, free, GRAVITY), (0.3, 0.9, -1.6, 0.4, 0.8, 0.0)
    plant = released(physics, free, start)

    def energy() -> float:
        qd = np.array(plant.qd)
        kinetic = 0.5 * qd @ (body.mass_matrix(plant.q) + np.diag(free.rotor)) @ qd
        return float(kinetic) + potential_energy(free, plant.q)

    before, drop = energy(), potential_energy(free, plant.q)
    for _ in range(450):
        plant.step(0.001)
    drop -= potential_energy(free, plant.q)
    assert drop > 10.0  # J: it really fell
    assert energy() == pytest.approx(before, abs=0.01 * drop)


def test_brakes_hold_and_stop_the_arm(arm: PumaModel, physics: str) -> None:
    home = arm.poses["home"].tolist()
    plant = ArmPlant(arm, GRAVITY, home, physics=physics)
    for _ in range(200):
        plant.step(0.001)
    assert list(plant.q) == home and plant.moves == 0
    plant.release(1)
    for _ in range(300):
        plant.step(0.001)
    fallen = plant.q[1]
    assert fallen < home[1] - 0.1 and plant.qd[1] < -0.5
    plant.brake(1)
    for _ in range(100):
        plant.step(0.001)
    assert plant.still and fallen - plant.q[1] < 0.05


@pytest.mark.parametrize(
    ("torque", "moves"), [(20.0, False), (-20.0, False), (32.0, True), (-32.0, True)]
)
def test_dry_friction_holds_up_to_its_limit(
    arm: PumaModel, torque: float, moves: bool, physics: str
) -> None:
    """Gravity has no effect on joint 1; its dry friction is 62.6 x 0.415 = 26 N m."""
    plant = released(physics, arm, arm.poses["home"].tolist(), range(1))
    for _ in range(100):
        plant.step(0.001, [torque, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert (plant.moves > 0) is moves
    assert bool(abs(plant.q[0] - arm.poses["home"][0]) > 1e-3) is moves


@pytest.mark.parametrize("factor", [1.0, 0.5, 0.3])
def test_speed_has_a_limit(arm: PumaModel, factor: float, physics: str) -> None:
    plant = released(physics, arm, arm.poses["home"].tolist(), range(1))
    plant.slow_down(factor)
    fastest = 0.0
    for _ in range(800):
        plant.step(0.001, [1e6, 0.0, 0.0, 0.0, 0.0, 0.0])
        fastest = max(fastest, plant.qd[0])
    assert 0.9 * factor < fastest / arm.speed[0] < 1.15 * factor


def test_torque_has_a_limit(arm: PumaModel, physics: str) -> None:
    home = arm.poses["home"].tolist()
    at_limit, beyond = (
        released(physics, arm, home, range(1)),
        released(physics, arm, home, range(1)),
    )
    for _ in range(30):
        at_limit.step(0.001, [arm.torque[0], 0.0, 0.0, 0.0, 0.0, 0.0])
        beyond.step(0.001, [10 * arm.torque[0], 0.0, 0.0, 0.0, 0.0, 0.0])
    assert at_limit.q == beyond.q


def test_hard_stops_end_the_motion(arm: PumaModel, physics: str) -> None:
    plant = released(physics, arm, [arm.upper[0] - 0.05, *arm.poses["home"][1:].tolist()], range(1))
    for _ in range(600):
        plant.step(0.001, [90.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert plant.q[0] == pytest.approx(arm.upper[0]) and plant.qd[0] == 0.0


@pytest.mark.parametrize("factor", [0.0, -1.0, 1.5])
def test_a_bad_speed_factor_is_refused(arm: PumaModel, factor: float, physics: str) -> None:
    plant = ArmPlant(arm, GRAVITY, QZ, physics=physics)
    with pytest.raises(ValueError, match="speed factor"):
        plant.slow_down(factor)


def test_step_size_hardly_matters(arm: PumaModel, physics: str) -> None:
    def swing(dt: float) -> Vector:
        plant = released(physics, arm, arm.poses["home"].tolist())
        for _ in range(round(0.3 / dt)):
            plant.step(dt, [60.0, 40.0, -20.0, 8.0, 6.0, 8.0])
        return np.array(plant.q)

    assert swing(0.001) == pytest.approx(swing(0.00025), abs=4e-3)


def _follow(site: Site, dt: float, physics: str) -> Vector:
    """Return joint angles (n, 6) every 4 ms of an arm whose drives follow a sweep of all joints
    back and forth, in steps of `dt` s."""
    arm, home = site.arm, site.arm.poses["home"]
    plant = ArmPlant(arm, GRAVITY, home.tolist(), physics=physics)
    servos = [
        JointServo(rating, angle) for rating, angle in zip(site.drives, home.tolist(), strict=True)
    ]
    for joint in range(6):
        plant.release(joint)
    path = []
    for cycle in range(300):
        sweep = 0.10 * (1.0 - math.cos(2.0 * math.pi * min(cycle, 250) / 125.0))
        for servo, angle in zip(servos, home.tolist(), strict=True):
            servo.aim(angle + sweep)
        for _ in range(round(0.004 / dt)):
            plant.step(
                dt,
                [s.torque(q, qd, dt) for s, q, qd in zip(servos, plant.q, plant.qd, strict=True)],
            )
        path.append(plant.q)
    plant.close()
    return np.array(path)


def test_steps_of_2_ms_give_the_same_motion_as_those_of_1_ms(site: Site, physics: str) -> None:
    """They agree as well as steps of 1 ms and of a quarter of that: the remaining difference is the
    integration error, not a lag."""
    coarse, usual, fine = (_follow(site, dt, physics) for dt in (0.002, 0.001, 0.00025))
    assert np.abs(usual - usual[0]).max() > 0.15
    assert np.abs(usual - fine).max() < 1e-3
    assert np.abs(coarse - usual).max() < 1e-3
