"""Kinematics of the SO-101: joint angles to the position of the gripper's tip, and back.

All lengths are those of Simulation/SO101/so101_new_calib.urdf in TheRobotStudio/SO-ARM100 (m). The
frame here has its origin on the pan axis at the level of the base's origin, x forward, y left and z
up at zero angles. Four joints turn about parallel or vertical axes, so both ways are closed forms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

JOINTS: Final = {
    "shoulder_pan": (-1.91986, 1.91986),
    "shoulder_lift": (-1.74533, 1.74533),
    "elbow_flex": (-1.69, 1.69),
    "wrist_flex": (-1.65806, 1.65806),
    "wrist_roll": (-2.79253, 2.79253),
    "gripper": (-0.174533, 1.74533),
}
"""Joints with their limits (rad), of the same file."""
LIMITS: Final = tuple(JOINTS.values())[:5]
SLACK: Final = 1e-6
"""Tolerance for rounding of an angle (rad) or a cosine."""
SHOULDER: Final = (0.0303992, 0.0948817 + 0.0542)
"""Lift axis: forward, up."""
UPPER: Final = (math.hypot(0.028, 0.11257), math.atan2(0.11257, 0.028))
FORE: Final = (math.hypot(0.1349, 0.0052), math.atan2(0.0052, 0.1349))
"""Links: length, and angle above the horizontal at zero angles."""
TOOL: Final = 0.0611 + 0.0981274
"""Wrist axis to the tip, along the roll axis."""
SIDE: Final = 0.0181 - 0.0182778
"""Roll axis to the left of the pan axis."""
TIP: Final = (-0.000218121, -0.0079)
"""Tip beside the roll axis at zero roll: left, up."""


def _tip(roll: float) -> tuple[float, float]:
    """Tip beside the roll axis: left, up."""
    left, up = TIP
    return (
        left * math.cos(roll) + up * math.sin(roll),
        up * math.cos(roll) - left * math.sin(roll),
    )


def forward(q: Sequence[float]) -> tuple[float, float, float, float]:
    """Return the tip's x, y, z (m) and the gripper's pitch (rad, 0 horizontal, positive upwards) of
    five angles."""
    pan, lift, elbow, wrist, roll = q
    pitch = -(lift + elbow + wrist)
    left, up = _tip(roll)
    angles = (UPPER[1] - lift, FORE[1] - lift - elbow, pitch)
    lengths = (UPPER[0], FORE[0], TOOL)
    r = SHOULDER[0] - up * math.sin(pitch)
    r += sum(length * math.cos(angle) for length, angle in zip(lengths, angles, strict=True))
    z = SHOULDER[1] + up * math.cos(pitch)
    z += sum(length * math.sin(angle) for length, angle in zip(lengths, angles, strict=True))
    left += SIDE
    c, s = math.cos(-pan), math.sin(-pan)
    return r * c - left * s, r * s + left * c, z, pitch


def inverse(x: float, y: float, z: float, pitch: float, roll: float) -> list[float]:
    """Return the five angles that bring the tip there: with the elbow up, and the arm facing the
    point if possible. `roll` is the angle of the joint wrist_roll.

    Raises ValueError if it is out of reach, or only with angles outside `JOINTS`.
    """
    where = f"({x:.3f}, {y:.3f}, {z:.3f}) m with pitch {pitch:.2f}"
    left, up = _tip(roll)
    left += SIDE
    (a, tilt), (b, bend) = UPPER, FORE
    if x * x + y * y < left * left:
        raise ValueError(f"{where}: too near the pan axis")
    ahead = math.sqrt(x * x + y * y - left * left)
    height = z - SHOULDER[1] - TOOL * math.sin(pitch) - up * math.cos(pitch)
    wrong = ""
    for far in (ahead, -ahead):  # facing it, or over the shoulder
        r = far - SHOULDER[0] - TOOL * math.cos(pitch) + up * math.sin(pitch)
        cosine = (r * r + height * height - a * a - b * b) / (2 * a * b)
        if abs(cosine) > 1.0 + SLACK:
            wrong = wrong or f"too {'far away' if cosine > 1.0 else 'near'}"
            continue
        bent = math.acos(min(1.0, max(-1.0, cosine)))
        for knee in (bent, -bent):
            upper = math.atan2(height, r) + math.atan2(b * math.sin(knee), a + b * math.cos(knee))
            lift, elbow = tilt - upper, knee - tilt + bend
            pan = math.atan2(left, far) - math.atan2(y, x)
            angles = (pan, lift, elbow, -pitch - lift - elbow)
            q = [*(math.remainder(angle, 2 * math.pi) for angle in angles), roll]
            within = [min(high, max(low, a)) for (low, high), a in zip(LIMITS, q, strict=True)]
            if math.dist(q, within) <= SLACK:
                return within
            outside = [
                f"{name} {angle:.2f}"
                for name, angle, near in zip(JOINTS, q, within, strict=False)
                if angle != near
            ]
            wrong = wrong or f"outside the limits of {', '.join(outside)} rad"
    raise ValueError(f"{where}: {wrong}")
