"""Task files in a short notation."""

from __future__ import annotations

import json
import re

from tests.studies.forecast.conftest import with_transitions


def task_text(text: str) -> str:
    """Return the text of a task file in which a line `name! action, action; key = value` is a
    primitive task with these alternatives (deadline: 9 s, or the keys) and the action place of its
    name. Transitions are lines as in `with_transitions`."""
    return with_transitions(re.sub(r"(?m)^(\w+)! ([\w, ]+)(?:; (.*))?$", _action, text))


def _action(line: re.Match[str]) -> str:
    name, actions, keys = line.groups()
    alternatives = json.dumps(actions.split(", "))
    return (
        f'[primitive_tasks.{name}]\ngoal = "done"\nalternatives = {alternatives}\n'
        f'{keys or "deadline = 9.0"}\n[places.{name}]\nkind = "action"\ntask = "{name}"'
    )
