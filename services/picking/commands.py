"""Commands for the drivers of the arms, and reading their states: only this module distinguishes
arms. To add your own arm, add a class to ARMS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from petrobot.services.picking.model import Gripper


class ArmState(NamedTuple):
    """The state of an arm for the actions: whether it is switched on, joint angles (rad), whether
    it is at its goal, the gap between its fingers (m; None if unknown), whether a part keeps them
    apart, whether they have stopped, and its faults."""

    on: bool
    q: tuple[float, ...]
    at_goal: bool
    grip: float | None
    held: bool
    gripped: bool
    fault: str


class Commands:
    """The commands of drivers of arms, and those of one kind of gripper."""

    def enable(self) -> Mapping[str, Any]:
        """Switch on, and clear faults."""
        return {"do": "enable"}

    def move(self, joints: Sequence[float]) -> Mapping[str, Any]:
        """Move to joint angles (rad)."""
        return {"do": "move", "joints": list(joints)}

    def open(self, gripper: Gripper, gap: float) -> Mapping[str, Any]:
        """Open the fingers to a gap (m)."""
        raise NotImplementedError

    def close(self, gripper: Gripper, gap: float) -> Mapping[str, Any]:
        """Close the fingers on what is between them, but not below a gap (m) if the gripper accepts
        one."""
        raise NotImplementedError

    def fingers(
        self, gripper: Gripper, state: Mapping[str, Any]
    ) -> tuple[float | None, bool, bool]:
        """Read `grip`, `held` and `gripped` of `ArmState`."""
        raise NotImplementedError

    def state(self, gripper: Gripper, state: Mapping[str, Any]) -> ArmState:
        """Read the driver's state."""
        faults = "; ".join(state["faults"].values())
        on, q = state["ready"] and not faults, tuple(state["q"])
        return ArmState(on, q, state["at_goal"], *self.fingers(gripper, state), faults)


class So101(Commands):
    """`petrobot.services.adapters.so101`: the gripper is a joint, and closes until it squeezes."""

    def open(self, gripper: Gripper, gap: float) -> Mapping[str, Any]:
        return {"do": "open", "angle": gap / gripper.numbers["gap_per_rad"]}

    def close(self, gripper: Gripper, gap: float) -> Mapping[str, Any]:
        """See `Commands`. It closes until it squeezes and ignores the gap."""
        return {"do": "close", "squeeze": gripper.numbers["squeeze"]}

    def fingers(
        self, gripper: Gripper, state: Mapping[str, Any]
    ) -> tuple[float | None, bool, bool]:
        jaw = state["gripper"]
        grip = max(0.0, jaw["angle"] * gripper.numbers["gap_per_rad"])
        held = jaw["holding"] and grip > CLOSED
        return grip, held, jaw["open"] or jaw["holding"] or jaw["closed"]


class Ur(Commands):
    """`petrobot.services.adapters.ur`: the gripper is connected to digital output 0 (close) and
    inputs 0 (holds something) and 1 (its fingers have stopped), and does not measure its gap."""

    def open(self, gripper: Gripper, gap: float) -> Mapping[str, Any]:
        """See `Commands`. It opens as far as it can."""
        return {"do": "output", "bit": 0, "value": False}

    def close(self, gripper: Gripper, gap: float) -> Mapping[str, Any]:
        return {"do": "output", "bit": 0, "value": True}

    def fingers(
        self, gripper: Gripper, state: Mapping[str, Any]
    ) -> tuple[float | None, bool, bool]:
        inputs = state["inputs"]
        return None, bool(inputs & 1) and bool(state["outputs"] & 1), bool(inputs & 2)


CLOSED: Final = 0.003
"""Gap up to which stopped fingers have met each other (m)."""
ARMS: Final[Mapping[str, Commands]] = {"feetech": So101(), "ur": Ur()}
