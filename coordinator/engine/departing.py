"""Where a mission run sets out that does not begin at the initial marking: tokens, runs that are
over, variables, latches."""

from __future__ import annotations

from petrobot.coordinator.conditions.wording import Severity
from petrobot.coordinator.engine.draft import Draft
from petrobot.coordinator.engine.instructions import Marked
from petrobot.coordinator.engine.state import Phase
from petrobot.coordinator.engine.stimuli import Point, Standing
from petrobot.coordinator.task import Memory, Scope


def set_out(draft: Draft, point: Point) -> None:
    """Stand at the point: its tokens, its ended runs, its variables and latched events. What the
    task does not know is reported.

    Action places hold as many tokens as runs stand there, whatever the marking says, so that both
    always agree.
    """
    net, before = draft.compiled.net, draft.snapshot()
    known = {place: n for place, n in point.marking.items() if place in net.place_index and n >= 0}
    actions = draft.compiled.action_places
    draft.marking[:] = [0 if place in actions else known.get(place, 0) for place in net.places]
    for place in sorted(set(point.marking) - set(known)):
        draft.report(
            Severity.WARNING,
            "bad_point",
            f"{place!r} is no place that can hold its tokens; left out",
            place,
        )
    for standing in point.standing:
        _stand(draft, standing)
    draft.emit(Marked("", before, draft.snapshot()))
    for name, value in point.variables.items():
        draft.write(name, value)
    draft.flags.update(name for name in point.flags if _is_latched(draft, name))


def _stand(draft: Draft, standing: Standing) -> None:
    index = draft.compiled.action_places.get(standing.place)
    if index is None:
        text = f"{standing.place!r} is no action place; no run stands there"
        draft.report(Severity.WARNING, "bad_point", text, standing.place)
        return
    draft.marking[index] += 1
    draft.enter(standing.place, index)
    if standing.status is None:
        return
    draft.end_order += 1
    run = draft.tokens[standing.place][-1]
    device = draft.compiled.devices.get(standing.action, "")
    over = {
        "status": standing.status,
        "cause": standing.cause,
        "action": standing.action,
        "device": device,
    }
    draft.put(run, phase=Phase.DONE, ended=draft.end_order, **over)


def _is_latched(draft: Draft, name: str) -> bool:
    event = draft.compiled.task.events.get(name)
    return event is not None and event.scope is Scope.EXTERNAL and event.memory is not Memory.PULSE
