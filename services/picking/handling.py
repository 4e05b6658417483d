"""Primitive actions of the arm: make ready, grasp, verify, place.

They use any arm whose driver is in `ARMS`; to add your own arm, add a class there. Their argument
`arm` is the file of the arm's numbers (`petrobot.services.picking.model.arm_named`), `cell` the
cell's file.

Error causes: `unreachable`, `arm_timeout`, `arm_fault`, `bad_part`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

from petrobot.services.action import (
    CommandRefused,
    Context,
    Result,
    error,
    failure,
    provisional,
    success,
)
from petrobot.services.picking.model import (
    ArmNumbers,
    Gripper,
    NumbersError,
    OutOfReachError,
    PartKind,
    PickingCell,
    arm_named,
    cell_named,
)

# --- commands and states of arms ---


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


# --- actions ---

ABOVE: Final = 0.065
"""Height over the table at which the finger tips travel (m)."""
LOW: Final = 0.03
"""Height over the table at which the fingers drop a part that must not be placed (m)."""
SEAT: Final = 0.012
"""How deep the fingers reach around a part (m)."""
FLOOR: Final = 0.004
"""Least height of the finger tips over the table (m)."""
GAP: Final = 0.012
"""How much wider than a part's side the fingers open if its direction is known (m)."""
SQUEEZE: Final = 0.006
"""How much further than a part's size the fingers are commanded to close (m)."""
ALONG: Final = 0.0
"""Direction in which the fingers close over a tray (rad)."""
TAKEN: Final = 0.06
"""Time until a driver's state shows the effect of a command (s)."""
CLOSING: Final = 2.0
"""Time within which the fingers stop (s)."""
FIT: Final = 0.003
"""Tolerance of the gap between the fingers, compared with the side that they hold (m)."""
SETTLE: Final = 0.25
"""Time for the fingers to grip before they are lifted (s)."""


class Grasp(NamedTuple):
    """How to grasp: position of the finger tips (m), direction of closing (rad), gap before, and
    gap to close to (m)."""

    x: float
    y: float
    z: float
    turn: float
    opening: float
    closing: float


class ArmError(Exception):
    """The arm did not do what it was commanded; cause and text."""

    def __init__(self, cause: str, text: str) -> None:
        super().__init__(cause, text)
        self.cause, self.text = cause, text

    def __str__(self) -> str:
        return self.text


# Where to grasp


def across(kind: PartKind, part: Mapping[str, Any], arm: ArmNumbers) -> Grasp:
    """Return a grasp across a part's narrow side. A round part has none: the fingers close across
    the direction from which the arm comes."""
    narrow, turn = min(kind.size), float(part["turn"]) + math.pi / 2
    if kind.round:
        turn = _arriving(part, arm)
    return Grasp(
        float(part["x"]),
        float(part["y"]),
        _depth(kind),
        turn,
        min(arm.gripper.opening, narrow + 2 * GAP),
        max(0.0, narrow - SQUEEZE),
    )


def at_centre(kind: PartKind, part: Mapping[str, Any], arm: ArmNumbers) -> Grasp:
    """Return a grasp at a part's middle, with the fingers wide open and closing across the
    direction from which the arm comes; closing turns the part."""
    return Grasp(
        float(part["x"]),
        float(part["y"]),
        _depth(kind),
        _arriving(part, arm),
        arm.gripper.opening,
        max(0.0, min(kind.size) - SQUEEZE),
    )


def _depth(kind: PartKind) -> float:
    return max(FLOOR, kind.height - SEAT)


def _arriving(part: Mapping[str, Any], arm: ArmNumbers) -> float:
    """Return the direction across the line from the arm's base to the part (rad)."""
    foot = arm.foot
    return math.atan2(float(part["y"]) - foot[1], float(part["x"]) - foot[0]) + math.pi / 2


# Actions


async def make_ready(
    ctx: Context, *, arm: str = "so101", cell: str = "cell", timeout: float = 20.0
) -> Result:
    """Switch the arm on, open the fingers and fold the arm out of the camera's view, whatever
    happened before. A part that the fingers still hold is put down in the search area.

    SUCCESS when it is there; ERROR `arm_fault` or `arm_timeout`.
    """
    try:
        hand, known = PickingArm(ctx, arm, timeout), cell_named(cell)
        await hand.enable()
        if hand.state.held:
            (x0, x1), (y0, y1) = known.area
            await hand.move(hand.arm.over((x0 + x1) / 2, (y0 + y1) / 2, LOW, ALONG, hand.state.q))
        await hand.open(hand.arm.gripper.opening)
        await hand.move(hand.arm.poses["rest"])
    except (ArmError, CommandRefused, NumbersError, OutOfReachError) as fault:
        return _error(fault)
    return success()


async def grasp_narrow(
    ctx: Context,
    *,
    part: Mapping[str, Any],
    arm: str = "so101",
    cell: str = "cell",
    timeout: float = 10.0,
) -> Result:
    """Grasp a part across its narrow side, lift it, and leave the camera's view.

    SUCCESS, provisionally: `picked` is the id of this run, `took` says whether the fingers closed
    on something; the action that verifies the grasp gives the verdict. ERROR `unreachable` if the
    arm cannot get there.
    """
    return await _grasp(ctx, across, part, arm, cell, timeout)


async def grasp_centre(
    ctx: Context,
    *,
    part: Mapping[str, Any],
    arm: str = "so101",
    cell: str = "cell",
    timeout: float = 10.0,
) -> Result:
    """Grasp a part at its middle without regard to its direction: faster, and enough for round
    parts. Otherwise as `grasp_narrow`."""
    return await _grasp(ctx, at_centre, part, arm, cell, timeout)


async def _grasp(
    ctx: Context,
    planned: Callable[[PartKind, Mapping[str, Any], ArmNumbers], Grasp],
    part: Mapping[str, Any],
    arm: str,
    cell: str,
    timeout: float,
) -> Result:
    try:
        hand = PickingArm(ctx, arm, timeout)
        grasp = planned(_kind(cell_named(cell), part), part, hand.arm)
        place = partial(hand.arm.over, grasp.x, grasp.y)
        above = place(ABOVE, grasp.turn, hand.state.q)
        middle = place((ABOVE + grasp.z) / 2, grasp.turn, above)
        down = place(grasp.z, grasp.turn, middle)
        await hand.open(grasp.opening)
        await hand.move(above, middle, down)
        await hand.close(grasp.closing)
        await ctx.sleep(SETTLE)
        took = hand.state.held
        await hand.move(middle, above, hand.arm.poses["rest"])
    except (ArmError, CommandRefused, NumbersError, OutOfReachError) as fault:
        return _error(fault)
    return provisional(success(picked=ctx.run, took=took))


async def verify_width(
    ctx: Context,
    *,
    part: Mapping[str, Any],
    picked: str = "",
    found: str = "",
    took: bool = False,
    arm: str = "so101",
    cell: str = "cell",
) -> Result:
    """Verify by the gap between the fingers that the part is held, and give the verdicts on the
    runs that found and picked it.

    SUCCESS if it is held at the right gap. FAILURE `missed`: the fingers closed on nothing; both
    runs get the verdict FAILURE. `wrong_kind`: they closed on something smaller; the run that found
    it gets it. `askew`: on something wider, and `slipped`: it was lost while being lifted (`took`);
    the run that grasped it gets it.
    """
    try:
        kind = _kind(cell_named(cell), part)
        state = PickingArm(ctx, arm, 1.0).state
    except (ArmError, NumbersError) as fault:
        return _error(fault)
    narrow, grip = min(kind.size), state.grip
    seen = "" if grip is None else f" to {1e3 * grip:.1f} mm"
    text = f"the fingers closed{seen}, the {kind.name} has {1e3 * narrow:.0f} mm"
    cause = ""
    if not state.held:
        cause = "slipped" if took else "missed"
    elif grip is not None and abs(grip - narrow) > FIT:
        cause = "askew" if grip > narrow else "wrong_kind"
    for run, blamed in (
        (found, ("missed", "wrong_kind")),
        (picked, ("missed", "askew", "slipped")),
    ):
        if run:
            ctx.verdict(run, failure(cause, text) if cause in blamed else success())
    if cause:
        return failure(cause, text)
    return success()


async def place_in_tray(
    ctx: Context,
    *,
    part: Mapping[str, Any],
    slots: Mapping[str, int] | None = None,
    arm: str = "so101",
    cell: str = "cell",
    timeout: float = 10.0,
) -> Result:
    """Put the part that is held into the next slot of the tray of its kind.

    SUCCESS, provisionally, if it was held until there: `slots` counts the parts in each tray,
    `tray` is the one used; the laboratory's score gives the verdict. FAILURE `lost_on_the_way` if
    it was not. Raises the event `tray_full` with the last slot.
    """
    try:
        hand, known = PickingArm(ctx, arm, timeout), cell_named(cell)
        kind = _kind(known, part)
        tray, used = known.trays[kind.tray], dict(slots or {})
        place = partial(
            hand.arm.over, *tray.slots[used.get(kind.tray, 0) % len(tray.slots)], turn=ALONG
        )
        above = place(z=ABOVE, near=hand.state.q)
        middle = place(z=(ABOVE + _depth(kind)) / 2, near=above)
        down = place(z=_depth(kind) + 0.001, near=middle)
        await hand.move(above, middle, down)
        held = hand.state.held
        await hand.open(min(hand.arm.gripper.opening, max(kind.size) + GAP))
        await hand.move(middle, above, hand.arm.poses["rest"])
    except (ArmError, CommandRefused, NumbersError, OutOfReachError) as fault:
        return _error(fault)
    if not held:
        return failure(
            "lost_on_the_way", "the fingers are empty over the tray", slots=used, tray=kind.tray
        )
    used[kind.tray] = used.get(kind.tray, 0) + 1
    if used[kind.tray] == len(tray.slots):
        ctx.raise_event("tray_full", tray=kind.tray)
    return provisional(success(slots=used, tray=kind.tray))


# Shared by the actions


def _kind(cell: PickingCell, part: Mapping[str, Any]) -> PartKind:
    try:
        float(part["x"]), float(part["y"]), float(part["turn"])
        return cell.kinds[str(part["kind"])]
    except (KeyError, TypeError, ValueError) as fault:
        raise ArmError(
            "bad_part",
            f"part: expected a table with x, y, turn and a kind of {', '.join(cell.kinds)}, found "
            f"{part!r:.80}",
        ) from fault


def _error(fault: Exception) -> Result:
    if isinstance(fault, ArmError):
        return error(fault.cause, fault.text)
    known = (OutOfReachError, "unreachable"), (NumbersError, "bad_numbers")
    cause = next((cause for kind, cause in known if isinstance(fault, kind)), "arm_fault")
    return error(cause, str(fault))


class PickingArm:
    """An arm with its numbers, as the actions use it."""

    def __init__(self, ctx: Context, arm: str, timeout: float) -> None:
        """Raises ArmError, NumbersError."""
        self.ctx, self.arm, self._timeout = ctx, arm_named(arm), timeout
        if self.arm.controller not in ARMS:
            raise ArmError(
                "bad_numbers",
                f"{arm}: controller: expected {' or '.join(ARMS)}, found {self.arm.controller!r}",
            )
        self._commands = ARMS[self.arm.controller]

    @property
    def state(self) -> ArmState:
        """Return the newest state of the arm."""
        return self._commands.state(self.arm.gripper, self.ctx.device.state)

    async def enable(self) -> None:
        """Switch the arm on, whatever happened before. A controller that is still starting refuses
        that at first, so try again. Raises CommandRefused."""
        due = self.ctx.now + self._timeout / 2
        while True:
            try:
                await self.ctx.command(self._commands.enable())
                break
            except CommandRefused:
                if self.ctx.now >= due:
                    raise
            await self.ctx.sleep(SETTLE)
        if not await self.ctx.wait(lambda: self.state.on, self._timeout / 2):
            raise ArmError("arm_fault", self.state.fault or "the arm does not switch on")
        await self.ctx.sleep(SETTLE)

    async def open(self, gap: float) -> None:
        """Open the fingers to a gap (m), and wait until they are open."""
        await self._fingers(self._commands.open(self.arm.gripper, gap))

    async def close(self, gap: float) -> None:
        """Close the fingers on what is between them, and wait until they have stopped."""
        await self._fingers(self._commands.close(self.arm.gripper, gap))

    async def _fingers(self, command: Mapping[str, Any]) -> None:
        await self.ctx.command(command)
        await self.ctx.sleep(TAKEN)
        await self.ctx.wait(lambda: self.state.gripped or bool(self.state.fault), CLOSING)

    async def move(self, *ways: Sequence[float]) -> None:
        """Move through joint angles (rad). Raises ArmError."""
        for joints in ways:
            await self.ctx.command(self._commands.move(joints))
            await self.ctx.sleep(TAKEN)
            there = await self.ctx.wait(
                lambda: self.state.at_goal or bool(self.state.fault), self._timeout
            )
            if fault := self.state.fault:
                raise ArmError("arm_fault", fault)
            if not there:
                raise ArmError(
                    "arm_timeout", f"the arm did not get there within {self._timeout:g} s"
                )
