"""Figures of the two physics back ends of the laboratory: how far they agree on the arm, and
whether the same balls are caught."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from tools.proof.catching import SAMPLE
from tools.proof.proof import KEPT, LOCK_STEP, ROOT, FigureProof, Result, digest, run_task

from petrobot.coordinator.learning.statistics import wilson
from petrobot.sim.catching.physics import BACK_ENDS, BULLET, PORTABLE, arm_dynamics
from petrobot.sim.catching.site import CupMount, read_site

CHAPTER = "Physics: Bullet and portable"
STATES = 3000
THROWS = 100
SEED = 31_000
FLOORS = {
    **dict.fromkeys(("A", "B", "C"), 0.9),
    "C+bouncy": 0.9,
    "B+bouncy": 0.9,
    "C+miscalibrated": 0.65,
    "C+latency400": 0.65,
    "C+arm30": 0.45,
    "B+latency400": 0.9,
    "C+springy": 0.2,
}
"""Least Wilson bound of the share caught, for both back ends: of nominal regimes, and of those with
errors of vision, time or cup, in which balls are missed."""
MARGIN, SPRINGY = 0.15, 0.3
"""Most by which the shares of the same balls may differ, with the interval of the difference; the
second in `C+springy`. What happens at the rim depends in Bullet on its step and its limit of the
spin; in the portable contact it does not (docs/physics.md, "The same balls")."""


def arm() -> Result:
    """Return the largest differences of the back ends over random states of the arm with its
    cup."""
    site = read_site(ROOT / "services" / "cell.toml")
    truth = site.truth("A")
    load = CupMount(site.arm, truth).load(0.080, truth.cup.radius, truth.cup.depth)
    one, other = (arm_dynamics(name, site.arm, 9.81, load) for name in BACK_ENDS)
    rng, torque, mass = np.random.default_rng(SEED), 0.0, 0.0
    for _ in range(STATES):
        a, b, c, d, e, f = rng.uniform(-3.2, 3.2, 6).tolist()
        u, v, w, x, y, z = rng.uniform(-4.0, 4.0, 6).tolist()
        q, qd = (a, b, c, d, e, f), (u, v, w, x, y, z)
        off = np.abs(np.subtract(one.bias(q, qd), other.bias(q, qd))).max()
        torque = max(torque, float(off))
        mass = max(mass, float(np.abs(one.mass_matrix(q) - other.mass_matrix(q)).max()))
    one.close()
    other.close()
    return {"states": STATES, "torque (N m)": torque, "mass matrix (kg m^2)": mass}


def same_balls(regime: str) -> Callable[[], Result]:
    """Run the same throws of a regime with both back ends."""

    def measure() -> Result:
        fates = {
            name: [throw["caught"] for throw in _thrown(name, regime, THROWS)] for name in BACK_ENDS
        }
        pairs = list(zip(fates[BULLET], fates[PORTABLE], strict=True))
        lost = sum(one and not other for one, other in pairs)
        won = sum(other and not one for one, other in pairs)
        low, high = paired_interval(lost, won, len(pairs))
        return {
            "throws": len(pairs),
            "caught, bullet": sum(fates[BULLET]),
            "caught, portable": sum(fates[PORTABLE]),
            "same fate": len(pairs) - lost - won,
            "difference from": round(low, 3),
            "difference to": round(high, 3),
        }

    return measure


def sample(regime: str) -> Callable[[], str]:
    """Run a few balls with both back ends; return a digest of all that is known of them."""
    return lambda: digest([_thrown(name, regime, SAMPLE) for name in BACK_ENDS])


def _thrown(physics: str, regime: str, throws: int) -> list[dict[str, Any]]:
    services = KEPT / f"{physics}_{regime}_{throws}.services.toml"
    text = (ROOT / "services.toml").read_text(encoding="utf-8")
    services.write_text(
        text.replace("[nodes.laboratory]\n", f'[nodes.laboratory]\nphysics = "{physics}"\n'),
        encoding="utf-8",
    )
    cell = ("catch_ball", "--services", str(services), "--mode", "lockstep", "--regime", regime)
    balls = ("--runs", str(throws), "--seed", str(SEED))
    found: list[dict[str, Any]] = run_task(f"{physics}_{regime}_{throws}", *cell, *balls)["throws"]
    return found


def paired_interval(lost: int, won: int, pairs: int) -> tuple[float, float]:
    """Return the 95 % interval of the difference of two shares of the same trials, of which one
    alone had `lost` and the other alone `won`.

    Wald's interval with one pair added to each of the two counts (Bonett and Price 2012).
    """
    one, other, n = (lost + 1) / (pairs + 2), (won + 1) / (pairs + 2), pairs + 2
    spread = 1.959964 * math.sqrt((one + other - (other - one) ** 2) / n)
    return other - one - spread, other - one + spread


def holds(regime: str) -> Callable[[Result], bool]:
    """Return the check of a regime: both back ends reach the floor, and their shares differ at most
    by the margin."""
    margin = SPRINGY if "springy" in regime else MARGIN

    def good(result: Result) -> bool:
        caught = (result["caught, bullet"], result["caught, portable"])
        floor = all(wilson(n, result["throws"])[0] >= FLOORS[regime] for n in caught)
        near = -margin <= result["difference from"] and result["difference to"] <= margin
        return bool(result["throws"] > 0 and floor and near)

    return good


def proofs() -> list[FigureProof]:
    """Return the proofs, the arm first."""
    on_arm = FigureProof(
        "arm, both back ends",
        CHAPTER,
        arm,
        lambda r: r["torque (N m)"] <= 1e-12 and r["mass matrix (kg m^2)"] <= 1e-12,
        "within 1e-12",
        LOCK_STEP,
        sample=lambda: digest(dict(arm())),  # it takes seconds
    )
    balls = [
        FigureProof(
            f"both back ends, {regime}",
            CHAPTER,
            same_balls(regime),
            holds(regime),
            f"lower bound of each >= {floor}, same shares within "
            f"{SPRINGY if 'springy' in regime else MARGIN}",
            LOCK_STEP,
            sample=sample(regime),
        )
        for regime, floor in FLOORS.items()
    ]
    return [on_arm, *balls]
