"""Pictures of what speaks against a task or net: each refused verdict drawn with the firings that
lead there."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from petrobot.coordinator.cli import CommandError
from petrobot.services.host.whole_file import make_folder, write_whole

if TYPE_CHECKING:
    from petrobot.coordinator.analysis.net.verdict import PropertyVerdict, Witness
    from petrobot.coordinator.analysis.report import Analysis
    from petrobot.coordinator.task import Task
    from petrobot.coordinator.task.net import Net

TOLD = 150
"""Letters of a reason below a picture."""


def draw_witnesses(analysis: Analysis, model: Task | Net, folder: Path) -> list[Path]:
    """One SVG for each verdict that is refused with a witness; gives their paths. Raises
    CommandError."""
    made = []
    try:
        make_folder(folder)
        for name, verdict in refused(analysis):
            assert verdict.witness is not None
            path = folder / f"{analysis.name}-{name}.svg"
            write_whole(path, picture(model, name, verdict.reason, verdict.witness))
            made.append(path)
    except OSError as fault:
        raise CommandError(
            2, f"{fault.filename or folder}: {fault.strerror or fault}; name a folder to write to"
        ) from fault
    return made


def refused(analysis: Analysis) -> Iterator[tuple[str, PropertyVerdict]]:
    """Verdicts that do not hold and can show why. A task need not be safe: several tokens are
    several runs to do."""
    order = sorted(analysis.verdicts().items(), key=lambda item: item[0] != "one_run_each")
    for name, verdict in order:
        if (
            verdict.holds is False
            and verdict.witness is not None
            and not (analysis.robot and name == "safe")
        ):
            yield name, verdict
    for recovery in analysis.robot.recoveries if analysis.robot else ():
        for name, verdict in (("possible", recovery.possible), ("sure", recovery.almost_sure)):
            if verdict.holds is False and verdict.witness is not None:
                yield f"{recovery.error_exit}-recovery-{name}", verdict
                break


def picture(model: Task | Net, name: str, reason: str, witness: Witness) -> str:
    """The net after the witness's firings, with the turns at which each transition fired (a loop
    goes on after them)."""
    from petrobot.coordinator.drawing import Overlay, draw
    from petrobot.coordinator.task.net import Net

    net = model if isinstance(model, Net) else model.net
    marking = tuple(witness.marking.get(place, 0) for place in net.places)
    told = reason if len(reason) <= TOLD else f"{reason[: TOLD - 1]}…"
    overlay = Overlay(
        path=(*witness.firings, *witness.loop), legend=f"{name.replace('_', ' ')}: NO. {told}"
    )
    return draw(model, error_branches=True, marking=marking, overlay=overlay)
