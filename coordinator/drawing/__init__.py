"""Drawings of tasks and nets as SVG text, readable on light and dark backgrounds."""

from __future__ import annotations

from collections.abc import Mapping

from petrobot.coordinator.drawing.scene import (
    Caption,
    Overlay,
    expanded,
    scene_of_net,
    scene_of_task,
)
from petrobot.coordinator.drawing.svg import render
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.net import Marking, Net

__all__ = ["Caption", "Overlay", "draw", "expanded"]


def draw(
    model: Task | Net,
    *,
    error_branches: bool = False,
    marking: Marking | None = None,
    title: str | None = None,
    overlay: Overlay | None = None,
    inside: str = "",
    captions: Mapping[str, Caption] | None = None,
) -> str:
    """Return the SVG text of a task or net.

    Macro places stay closed, and error branches are hidden unless `error_branches`; a badge on a
    place counts its hidden outgoing transitions. `marking` (of `Task.net`, or of the net) replaces
    the initial tokens. `overlay` colours nodes and numbers the firings of a path. `inside` opens a
    macro place, named as in the flat task; raises ValueError if there is none. `captions` replace
    the labels of the nodes of a net.
    """
    scene = (
        scene_of_net(model, marking, title, captions)
        if isinstance(model, Net)
        else scene_of_task(model, error_branches, marking, title, inside)
    )
    return render(scene.under(overlay) if overlay else scene)
