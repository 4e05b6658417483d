"""Figures of the two back ends of the laboratory's mechanics: how far they agree on the arm, and
whether the same balls are caught."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from tools.proof.proof import KEPT, ROOT, FigureProof, Result, run_task

from petrobot.sim.catching.physics import BACK_ENDS, BULLET, PORTABLE, arm_dynamics
from petrobot.sim.catching.site import CupMount, read_site

CHAPTER = "Physics: Bullet and portable"
SOURCES = ("services.toml", "services", "sim", "coordinator/tasks/catch_ball.toml")
APART = ("services/mobile", "sim/track")
STATES = 3000
THROWS = 100
SEED = 31_000
REGIMES = (
    *("A", "B", "C"),
    *("C+miscalibrated", "C+latency400", "C+arm30", "C+bouncy", "B+bouncy", "B+latency400"),
)
"""Nominal regimes, and those in which balls are missed, by errors of vision, time, and cup."""
DOUBT = 0.01
"""Least p of the sign test on the balls whose fate differs (McNemar)."""


def arm() -> Result:
    """Largest differences of the back ends over random states of the arm with its cup."""
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
    """The same throws of a regime with both back ends."""

    def measure() -> Result:
        fates = {name: _caught(name, regime) for name in BACK_ENDS}
        pairs = list(zip(fates[BULLET], fates[PORTABLE], strict=True))
        lost = sum(one and not other for one, other in pairs)
        won = sum(other and not one for one, other in pairs)
        return {
            "throws": len(pairs),
            "caught, bullet": sum(fates[BULLET]),
            "caught, portable": sum(fates[PORTABLE]),
            "same fate": len(pairs) - lost - won,
            "p": round(sign_test(lost, won), 3),
        }

    return measure


def _caught(physics: str, regime: str) -> list[bool]:
    services = KEPT / f"{physics}.services.toml"
    text = (ROOT / "services.toml").read_text(encoding="utf-8")
    services.write_text(
        text.replace("[nodes.laboratory]\n", f'[nodes.laboratory]\nphysics = "{physics}"\n'),
        encoding="utf-8",
    )
    given = ("catch_ball", "--services", str(services), "--mode", "lockstep", "--regime", regime)
    found = run_task(f"{physics}_{regime}", *given, "--runs", str(THROWS), "--seed", str(SEED))
    return [throw["caught"] for throw in found["throws"]]


def sign_test(one: int, other: int) -> float:
    """Return the two-sided p of so many differences in each direction, each as likely."""
    n, least = one + other, min(one, other)
    tail = sum(math.comb(n, k) for k in range(least + 1)) / float(2**n)
    return min(1.0, 2.0 * tail)


def proofs() -> list[FigureProof]:
    """The arm first."""
    on_arm = FigureProof(
        "arm, both back ends",
        CHAPTER,
        arm,
        lambda r: r["torque (N m)"] <= 1e-12 and r["mass matrix (kg m^2)"] <= 1e-12,
        "within 1e-12",
        SOURCES,
        APART,
    )
    balls = [
        FigureProof(
            f"both back ends, {regime}",
            CHAPTER,
            same_balls(regime),
            lambda r: r["p"] >= DOUBT and r["throws"] > 0,
            f"same balls caught but for chance (p >= {DOUBT})",
            SOURCES,
            APART,
        )
        for regime in REGIMES
    ]
    return [on_arm, *balls]
