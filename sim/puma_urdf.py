"""Writes the arm as URDF, so that PyBullet computes its mass matrix and its gravity, Coriolis and
centrifugal torques.

A URDF joint turns before its link's fixed DH transform, so the link frame of joint i is DH frame
i-1 turned by q_i; the inertial values, which the literature gives in DH frame i, are moved there.

Two traps of Bullet are met here. It zeroes a tensor that breaks the triangle inequality (Ixx <= Iyy
+ Izz and so on), as the published ones of links 1 and 3 do; and it gives a link without mass 1 kg.
`_physical` mends the first, `_LEAST_MASS` the second. Rotor inertia has no place in a URDF: it is
added to the mass matrix (sim/puma.py).
"""

from __future__ import annotations

from petrobot.sim.puma_model import ArmModel, Link

_LEAST_MASS = 1e-9
_ZERO = (0.0, 0.0, 0.0)


def urdf(model: ArmModel, flange_load: Link | None = None) -> str:
    """The arm as URDF text: links base, link1 to link6; `flange_load`: what is bolted to link 6, in
    frame 6."""
    parts = [
        '<robot name="arm">',
        f'<link name="base">{_inertial_text(Link(0.0, _ZERO, _ZERO), _ZERO, 0.0)}</link>',
    ]
    for i, link in enumerate(model.links):
        x, y, z = model.base if i == 0 else (model.a[i - 1], 0.0, model.d[i - 1])
        roll = 0.0 if i == 0 else model.alpha[i - 1]
        parent = "base" if i == 0 else f"link{i}"
        parts.append(
            f'<joint name="joint{i + 1}" type="revolute"><parent link="{parent}"/><child '
            f'link="link{i + 1}"/>'
            f'<origin xyz="{x!r} {y!r} {z!r}" rpy="{roll!r} 0 0"/><axis xyz="0 0 1"/>'
            f'<limit lower="{model.lower[i]}" upper="{model.upper[i]}" effort="{model.torque[i]}" '
            f'velocity="{model.speed[i]}"/></joint>'
        )
        parts.append(f'<link name="link{i + 1}">{_inertial(model, i, link)}</link>')
    if flange_load is not None:
        end = len(model.links) - 1
        parts.append(
            '<joint name="load" type="fixed"><parent link="link6"/><child link="load"/>'
            f'<origin xyz="{model.a[end]!r} 0 {model.d[end]!r}" rpy="{model.alpha[end]!r} 0 '
            '0"/></joint>'
            f'<link name="load">{_inertial_text(flange_load, flange_load.centre, 0.0)}</link>'
        )
    parts.append("</robot>")
    return "\n".join(parts)


def _inertial(model: ArmModel, i: int, link: Link) -> str:
    """The link's inertial element: its centre moved from DH frame i + 1 to the URDF link frame,
    turned by the twist."""
    c, s = model.twists[i]
    x, y, z = link.centre
    return _inertial_text(
        link, (model.a[i] + x, c * y - s * z, model.d[i] + s * y + c * z), model.alpha[i]
    )


def _inertial_text(link: Link, centre: tuple[float, float, float], roll: float) -> str:
    ixx, iyy, izz = _physical(link.inertia)
    x, y, z = centre
    return (
        f'<inertial><origin xyz="{x!r} {y!r} {z!r}" rpy="{roll!r} 0 0"/><mass '
        f'value="{max(link.mass, _LEAST_MASS)!r}"/>'
        f'<inertia ixx="{ixx!r}" iyy="{iyy!r}" izz="{izz!r}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def _physical(inertia: tuple[float, float, float]) -> tuple[float, float, float]:
    """The tensor with its lesser moments raised as little as makes it one of a real body; the
    greatest is kept.

    Where a lesser moment was left out because the link never turns about that axis (link 1),
    raising it changes nothing; for link 3 it is 0.004 of 0.086 kg m^2, less than what the
    publications differ by.
    """
    order = sorted(range(3), key=lambda k: inertia[k])
    lack = inertia[order[2]] - inertia[order[0]] - inertia[order[1]]
    if lack <= 0.0:
        return inertia
    # a little above equality: Bullet compares in rounded arithmetic
    share = 0.5 * lack * (1.0 + 1e-9) + 1e-12
    mended = list(inertia)
    mended[order[0]] += share
    mended[order[1]] += share
    return mended[0], mended[1], mended[2]
