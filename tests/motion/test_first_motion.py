"""The PUMA's driver keeps the rules of drivers, and obeys `speed`, `workspace` and `dry_run`."""

from __future__ import annotations

from typing import Any

import pytest

from petrobot.services.comm.canopen.cia301 import RPDO1_BASE
from petrobot.services.conformance import DriverCheck, check_driver
from petrobot.services.motion.arm import PERIOD, Arm
from petrobot.services.motion.kinematics import Puma
from petrobot.services.motion.limits import CollisionGuard
from petrobot.services.motion.model import nominal_arm, nominal_cell

ARM = nominal_arm()
HOME = ARM.poses["home"]
THERE = [HOME[0] + 1.2, *HOME[1:]]
GUARD = CollisionGuard(Puma.of(ARM), ARM, nominal_cell())


def mouth(q: Any) -> tuple[float, float, float]:
    """The middle of the cup's mouth (m)."""
    return GUARD.place(q).mouth


def around(*poses: Any, by: float = 0.05) -> dict[str, list[float]]:
    """A workspace with the cup's places in these poses."""
    places = list(zip(*map(mouth, poses), strict=True))
    return {a: [min(p) - by, max(p) + by] for a, p in zip("xyz", places, strict=True)}


def checked(make_rig: Any) -> DriverCheck:
    """Check the driver on its simulated bus, which goes on with each step; without its cable the
    bus is silent."""
    rig = make_rig()

    class OnBus(Arm):
        """Its world goes on while it steps."""

        def step(self, now: float) -> None:
            rig.cycle = round(now / PERIOD)
            super().step(now)
            rig._laboratory()

    def make(**keys: Any) -> Arm:
        rig.wire.dead = False
        return OnBus(keys, rig)

    def cable(there: bool) -> None:
        rig.wire.cut = not there

    commands = [{"do": "move", "pose": THERE}, {"do": "move", "pose": list(HOME)}]
    return check_driver(make, commands, seconds=2.5, cable=cable, simulated=True)


def test_it_keeps_the_rules_of_drivers(make_rig: Any) -> None:
    found = checked(make_rig)
    assert found.faults == [] and found.notes == []


@pytest.mark.parametrize("way", ["cut", "dead"])
def test_without_its_bus_it_knows_that_the_arm_stands_when_the_drives_must_have_stopped(
    rig: Any, way: str
) -> None:
    setattr(rig.wire, way, True)
    rig.run(0.1)
    assert not rig.arm.stopped()
    rig.run(1.3)
    assert rig.arm.stopped() and all(rig.plant.braked)


def test_at_a_quarter_of_its_speed_no_joint_is_faster(make_rig: Any) -> None:
    fastest = {}
    for share in (1.0, 0.25):
        rig = make_rig(config={"speed": share}).enable()
        rig.arm.command(rig.now, {"do": "move", "pose": THERE})
        speeds: list[float] = []
        assert rig.run(4.0, lambda r=rig, s=speeds: bool(s.append(abs(r.arm.state()["qd"][0])))
                       or r.arm.state()["in_place"])  # fmt: skip
        fastest[share] = max(speeds)
    assert 0.2 < fastest[0.25] / ARM.speed[0] < 0.26 < fastest[1.0] / ARM.speed[0]


def test_a_pose_outside_the_workspace_is_refused_with_point_and_box(make_rig: Any) -> None:
    rig = make_rig(config={"workspace": around(HOME)}).enable()
    with pytest.raises(ValueError) as fault:
        rig.arm.command(rig.now, {"do": "move", "pose": THERE})
    x, y, _ = mouth(THERE)
    assert f"the point x = {x:.3f}, y = {y:.3f}" in str(fault.value)
    assert "outside the workspace x = [" in str(fault.value)
    rig.run(0.5)
    assert mouth(rig.arm.state()["q"]) == pytest.approx(mouth(HOME), abs=1e-3)


def test_a_path_never_leaves_the_workspace(make_rig: Any) -> None:
    """Both ends lie inside, the arc between them does not: the arm stops before it leaves."""
    aside = [[HOME[0] + turn, *HOME[1:]] for turn in (-0.6, 0.6)]
    box = around(*aside, by=0.01)
    rig = make_rig(start=aside[0], config={"workspace": box}).enable()
    low, high = box["x"]
    assert not low <= mouth(HOME)[0] <= high
    rig.arm.command(rig.now, {"do": "move", "pose": aside[1]})
    rig.commanded.clear()
    rig.run(3.0)
    xs = [mouth(q)[0] for q in rig.commanded]
    assert low <= min(xs) and max(xs) <= high and max(xs) - min(xs) > 0.005
    assert rig.arm.stopped() and not rig.arm.state()["in_place"]
    assert "outside the workspace" in rig.arm.state()["guard"]


def test_in_a_dry_run_the_arm_reports_its_moves_and_no_drive_is_enabled(make_rig: Any) -> None:
    rig = make_rig(config={"dry_run": True})
    rig.wire.log = []
    rig.enable()
    rig.arm.command(rig.now, {"do": "move", "pose": THERE})
    assert rig.run(4.0, lambda: rig.arm.state()["in_place"])
    assert rig.arm.state()["q"] == pytest.approx(THERE, abs=0.01)
    assert rig.plant.q == pytest.approx(HOME) and all(rig.plant.braked)
    words = {f.data[:2] for f in rig.wire.log if RPDO1_BASE < f.id <= RPDO1_BASE + 6}
    assert words == {b"\x00\x00"}, "only `disable voltage`"
