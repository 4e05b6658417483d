"""Write docs/figures.md: one table per chapter, with everything that was and was not measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tools.proof.proof import FigureProof

HEAD = """# Figures

What petrobot promises, and what was measured. `make proof` writes this page from figures.json;
anyone can repeat it. It resumes where it stopped, and measures again what has changed since.

`floor` is the least that is promised, `holds` says whether the measurement reaches it. `sources`
identifies the measured code (without comments and layout); `(older)` means that the code has
changed since, and `a = b` that it was measured at a, and that at b a short measurement of the same
kind gave the same numbers to the last digit: ten balls, or a hundredth of a study. Each row of a
disturbed regime is 200 runs with the first alternative of each task. Fewer throws: the ball was not
seen, or the task gave up; more: balls went by unseen.

Multiples of real time are those of one host. On a slower one, at 9bdedfba, one seed ran 6.7 and 2.5
times as fast as real time, and a campaign 7.6 times a core, below the floors. On that host the code
of 1eefa30 is as fast as this one within 1 % (bullet, regime B, least CPU times in turns).

How faults that were injected on purpose ended: [figures-faults.md](figures-faults.md).
"""


def figures(proofs: Sequence[FigureProof], measured: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the whole page; `measured`: the stored result of each proof by its name."""
    chapters = list(dict.fromkeys(proof.chapter for proof in proofs))
    parts = [HEAD]
    for chapter in chapters:
        parts += [
            f"\n## {chapter}\n",
            *_table([p for p in proofs if p.chapter == chapter], measured),
        ]
    return "\n".join(parts) + "\n"


def _table(proofs: Sequence[FigureProof], measured: Mapping[str, Mapping[str, Any]]) -> list[str]:
    columns = list(
        dict.fromkeys(key for p in proofs for key in measured.get(p.name, {}).get("result", {}))
    )
    lines = [_row("", *columns, "floor", "holds", "sources"), _row(*["---"] * (len(columns) + 4))]
    for proof in proofs:
        data = measured.get(proof.name)
        if data is None:
            lines.append(_row(proof.name, *[""] * len(columns), proof.floor, "not measured", ""))
            continue
        holds = "yes" if data["holds"] else "**no**"
        sources = data["sources"][:8]
        if not proof.holds_for(data):
            sources += " (older)"
        elif data["sources"] != proof.fingerprint():
            sources += f" = {data['same_at'][:8]}"
        values = [_said(data["result"].get(key)) for key in columns]
        lines.append(_row(proof.name, *values, proof.floor, holds, sources))
    return lines


def _said(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "" if value is None else str(value)


def _row(*cells: str) -> str:
    return "| " + " | ".join(cells) + " |"
