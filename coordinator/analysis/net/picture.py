"""A reachability graph as SVG, in columns by distance from the initial marking.

Dead markings, final markings and the path of a witness are coloured.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from petrobot.coordinator.analysis.net.graph import Mask
from petrobot.coordinator.analysis.net.space import Space

MARKINGS = 400
"""The most markings drawn; a picture of more is unreadable."""
COLUMN, ROW, WIDE, HIGH = 220, 46, 170, 30
STYLE = """
.m rect{fill:#f6f8fa;stroke:#57606a;rx:6}.m text,.e text{font:11px sans-serif;fill:#24292f}
.m text{text-anchor:middle}
.m.initial rect{stroke-width:3}.m.dead rect{fill:#ffd7d5;stroke:#cf222e}
.m.final rect{fill:#dafbe1;stroke:#1a7f37}
.e path{fill:none;stroke:#8c959f;marker-end:url(#head)}.e text{fill:#57606a;font-size:10px}
.on path{stroke:#bf3989;stroke-width:2.5}.on text{fill:#bf3989;font-weight:bold}
.m.on rect{stroke:#bf3989;stroke-width:2.5}
@media(prefers-color-scheme:dark){.m rect{fill:#21262d}.m text{fill:#e6edf3}.e text{fill:#8b949e}
.m.dead rect{fill:#67060c}.m.final rect{fill:#033a16}}
"""


def graph_svg(
    space: Space,
    *,
    witness: Sequence[str] = (),
    final: Mask | None = None,
    markings: int = MARKINGS,
) -> str:
    """Return the SVG text of a space.

    At most `markings` markings are drawn: those nearest to the initial one, plus those of the
    witness. `witness` is a firing sequence from the initial marking; `final` says which markings
    are designed ends. Raises ValueError if the witness leaves the space.
    """
    steps = _steps(space, witness)
    shown = sorted(
        {*range(min(len(space), markings)), *(i for i, _, _ in steps), *(j for _, _, j in steps)}
    )
    depth = _depths(space, shown)
    at: dict[int, tuple[int, int]] = {}
    filled: dict[int, int] = {}
    for i in shown:
        row = filled.get(depth[i], 0)
        filled[depth[i]] = row + 1
        at[i] = (20 + depth[i] * COLUMN, 20 + row * ROW)
    width, height = (
        max(x for x, _ in at.values()) + WIDE + 20,
        max(y for _, y in at.values()) + HIGH + 40,
    )
    on = {(i, t) for i, t, _ in steps}
    visited = {0} | {j for _, _, j in steps} if steps else set()
    body = [*_edges(space, shown, at, on), *_nodes(space, shown, at, final, visited)]
    if len(shown) < len(space) or not space.complete:
        partial = "" if space.complete else f" (partial: {escape(space.reason)})"
        told = f"{len(shown)} of {len(space)} markings shown{partial}"
        body.append(f'<text x="20" y="{height - 10}" class="m">{told}</text>')
    head = (
        '<marker id="head" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="7" '
        'markerHeight="7" orient="auto"><path d="M0 0L8 4L0 8z" fill="#8c959f"/></marker>'
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}" role="img">'
        "<title>Reachability "
        f"graph</title><style>{STYLE}</style><defs>{head}</defs>{''.join(body)}</svg>\n"
    )


def _steps(space: Space, witness: Sequence[str]) -> list[tuple[int, int, int]]:
    """Return (marking, transition, marking) for each firing. Raises ValueError outside the
    space."""
    at, out = 0, []
    for name in witness:
        t = space.net.transition_index[name]
        edges = np.flatnonzero(space.label[space.row[at] : space.row[at + 1]] == t) + space.row[at]
        if not len(edges):
            raise ValueError(f"the witness fires {name}, but marking {at} has no such edge")
        out.append((at, t, int(space.target[edges[0]])))
        at = out[-1][2]
    return out


def _depths(space: Space, shown: Sequence[int]) -> dict[int, int]:
    """Return the distance of the shown markings from the initial one."""
    # Breadth-first numbers: the parent of a marking always has a smaller number.
    depth = np.zeros(len(space), dtype=np.int64)
    parent = space.parent_edge
    for i in range(1, max(shown) + 1):
        depth[i] = depth[space.source[parent[i]]] + 1
    return {i: int(depth[i]) for i in shown}


def _edges(
    space: Space, shown: Sequence[int], at: dict[int, tuple[int, int]], on: set[tuple[int, int]]
) -> list[str]:
    out = []
    for i in shown:
        for e in range(int(space.row[i]), int(space.row[i + 1])):
            j, t = int(space.target[e]), int(space.label[e])
            if j not in at:
                continue
            (x, y), (u, v) = at[i], at[j]
            start, end = (x + WIDE, y + HIGH // 2), (u, v + HIGH // 2)
            if u <= x:  # backwards or within a column: leave and arrive at the lower border
                start, end = (x + WIDE // 2, y + HIGH), (u + WIDE // 2, v + HIGH)
                path = (
                    f"M{start[0]} {start[1]}C{start[0]} {start[1] + 40} {end[0]} "
                    f"{end[1] + 40} {end[0]} {end[1]}"
                )
            else:
                middle = (start[0] + end[0]) // 2
                path = (
                    f"M{start[0]} {start[1]}C{middle} {start[1]} {middle} {end[1]} "
                    f"{end[0]} {end[1]}"
                )
            x, y, name = (
                (start[0] + end[0]) // 2,
                (start[1] + end[1]) // 2 - 3,
                escape(space.net.transitions[t]),
            )
            label = f'<text x="{x}" y="{y}">{name}</text>'
            out.append(f'<g class="e{" on" if (i, t) in on else ""}"><path d="{path}"/>{label}</g>')
    return out


def _nodes(
    space: Space,
    shown: Sequence[int],
    at: dict[int, tuple[int, int]],
    final: Mask | None,
    visited: set[int],
) -> list[str]:
    dead, out = set(space.dead.tolist()), []
    for i in shown:
        x, y = at[i]
        kinds = ["m"] + ["initial"] * (i == 0) + ["on"] * (i in visited)
        kinds += ["final"] if final is not None and final[i] else ["dead"] if i in dead else []
        text = space.net.describe(space.marking(i))
        short = text if len(text) <= 26 else text[:25] + "…"
        out.append(
            f'<g class="{" ".join(kinds)}"><title>{i}: {escape(text)}</title><rect x="{x}" '
            f'y="{y}" width="{WIDE}" height="{HIGH}"/>'
            f'<text x="{x + WIDE // 2}" y="{y + HIGH // 2 + 4}">{escape(short)}</text></g>'
        )
    return out
