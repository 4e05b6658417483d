"""What the drivers of the arms are told, and how their states are read: the only place that knows
one arm from another. An arm of yours is one more class in ARMS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple, Protocol

from petrobot.services.picking.model import Gripper


class ArmState(NamedTuple):
    """An arm as the actions see it: whether it is switched on, joint angles (rad), whether it
    stands at its goal, the gap between its fingers (m; None if it is not known), whether something
    holds them apart, whether they have stopped, and what is wrong with it."""

    on: bool
    q: tuple[float, ...]
    at_goal: bool
    grip: float | None
    held: bool
    gripped: bool
    fault: str


class Commands(Protocol):
    """The commands of one kind of driver."""

    def enable(self) -> Mapping[str, Any]:
        """Switch on, and forget faults."""

    def move(self, joints: Sequence[float]) -> Mapping[str, Any]:
        """Move to joint angles (rad)."""

    def open(self, gripper: Gripper, gap: float) -> Mapping[str, Any]:
        """Open the fingers to a gap (m)."""

    def close(self, gripper: Gripper, gap: float) -> Mapping[str, Any]:
        """Close the fingers on what is between them, at the least to a gap (m) if the gripper knows
        one."""

    def state(self, gripper: Gripper, state: Mapping[str, Any]) -> ArmState:
        """Read the driver's state."""


class So101:
    """`petrobot.services.adapters.so101`: the gripper is a joint, and closes until it squeezes."""

    def enable(self) -> Mapping[str, Any]:
        """See `Commands`."""
        return {"do": "reset"}

    def move(self, joints: Sequence[float]) -> Mapping[str, Any]:
        """See `Commands`."""
        return {"do": "move", "joints": list(joints)}

    def open(self, gripper: Gripper, gap: float) -> Mapping[str, Any]:
        """See `Commands`."""
        return {"do": "open", "angle": gap / gripper.numbers["gap_per_rad"]}

    def close(self, gripper: Gripper, gap: float) -> Mapping[str, Any]:
        """See `Commands`. It closes until it squeezes, however far that is."""
        return {"do": "close", "squeeze": gripper.numbers["squeeze"]}

    def state(self, gripper: Gripper, state: Mapping[str, Any]) -> ArmState:
        """See `Commands`."""
        jaw = state["gripper"]
        grip = max(0.0, jaw["angle"] * gripper.numbers["gap_per_rad"])
        faults = "; ".join(state["faults"].values())
        return ArmState(
            state["torque"] and not faults,
            tuple(state["q"]),
            state["at_goal"],
            grip,
            jaw["holding"] and grip > CLOSED,
            jaw["open"] or jaw["holding"] or jaw["closed"],
            faults,
        )


class Ur:
    """`petrobot.services.adapters.ur`: the gripper hangs on digital output 0 (close) and inputs 0
    (holds something) and 1 (its fingers stand), and does not know its gap."""

    def enable(self) -> Mapping[str, Any]:
        """See `Commands`."""
        return {"do": "enable"}

    def move(self, joints: Sequence[float]) -> Mapping[str, Any]:
        """See `Commands`."""
        return {"do": "move", "q": list(joints)}

    def open(self, gripper: Gripper, gap: float) -> Mapping[str, Any]:
        """See `Commands`. It opens as far as it can."""
        return {"do": "output", "bit": 0, "value": False}

    def close(self, gripper: Gripper, gap: float) -> Mapping[str, Any]:
        """See `Commands`."""
        return {"do": "output", "bit": 0, "value": True}

    def state(self, gripper: Gripper, state: Mapping[str, Any]) -> ArmState:
        """See `Commands`."""
        inputs = state["inputs"]
        return ArmState(
            state["enabled"],
            tuple(state["q"]),
            state["in_place"],
            None,
            bool(inputs & 1) and bool(state["outputs"] & 1),
            bool(inputs & 2),
            state["fault"],
        )


CLOSED: Final = 0.003
"""m up to which fingers that are stopped have met each other."""
ARMS: Final[Mapping[str, Commands]] = {"feetech": So101(), "ur": Ur()}
