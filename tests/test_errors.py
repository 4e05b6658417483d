"""An error that ends a trial reaches the process that asked for it as it was raised: pools and Dask
send it with pickle, which calls the class with `args`. So `args` are what the class is called with,
and the words are those of `__str__`."""

from __future__ import annotations

import ast
import builtins
import pickle

import pytest

from petrobot.coordinator.analysis.formats.netfile import NetFileError
from petrobot.coordinator.background import RefusedError, Superseded
from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.page.task_store import Conflict, TaskText
from petrobot.coordinator.run.mission import MissionError
from petrobot.coordinator.run.realtime import UnreachableError
from petrobot.coordinator.task.conditions.language import ConditionError
from petrobot.coordinator.task.elements import Kind, Place
from petrobot.coordinator.task.expansion import CircleError
from petrobot.coordinator.task.file.reading import TaskFileError
from petrobot.coordinator.task.wording import Fault
from petrobot.services.action import CallFailed, error
from petrobot.services.comm.canopen.cia301 import SdoAbortError
from petrobot.services.comm.location_file import DirectoryError
from petrobot.services.comm.lockstep.mesh import PartyLostError
from petrobot.services.comm.protocol.codec import ProtocolError
from petrobot.services.comm.protocol.messages import Cancel
from petrobot.services.host.toml_text import TomlError
from petrobot.services.picking.handling import ArmError
from petrobot.services.worker.runner import Returned
from tests.test_layout import parsed

RAISED = [
    NetFileError("net.pnml", "place p1", "has no id", "give it one", line=7),
    MissionError("the journal is of another task", bad_input=True),
    UnreachableError(["vision", "motion"], "vision, motion: nobody answers"),
    ConditionError("a closing bracket is missing", "(x > 1", 6),
    CircleError(("leg",), Place("again", Kind.MACRO, subnet="leg")),
    TaskFileError("task.toml", [Fault("places.free", "is missing", "write it")], [3]),
    CallFailed("scan", error("lost", "no answer")),
    DirectoryError(("nodes.vision: no port", "nodes.motion: no port")),
    PartyLostError("arm", "no Tick for 5 s"),
    RefusedError(422, "the task cannot be drawn", {"line": 3}),
    Superseded(),
    Conflict(TaskText("a.toml", "theirs"), "yours"),
    CommandError(2, "no such task"),
    ArmError("not_reached", "it stands 3 mm beside"),
    Returned({"x": 1}),
    ProtocolError("malformed", "not a message", [Cancel("r", "stop")]),
    SdoAbortError(0x06020000, 0x6040, 1),
    TomlError("cell.toml", 3, "cup.mouth", "already written in line 2", "drop one of the two"),
]


def with_constructors() -> set[str]:
    """Return the exception classes of the package whose `__init__` is their own."""
    classes = [n for *_, nodes in parsed() for n in nodes if isinstance(n, ast.ClassDef)]
    errors = {name for name, one in vars(builtins).items() if isinstance(one, type)}
    errors = {name for name in errors if issubclass(getattr(builtins, name), BaseException)}
    while new := {c.name for c in classes if errors & {ast.unparse(b) for b in c.bases}} - errors:
        errors |= new
    return {
        c.name
        for c in classes
        if c.name in errors
        and any(isinstance(m, ast.FunctionDef) and m.name == "__init__" for m in c.body)
    }


def test_every_error_with_a_constructor_is_tried() -> None:
    assert {type(raised).__name__ for raised in RAISED} == with_constructors()


@pytest.mark.parametrize("raised", RAISED, ids=lambda raised: type(raised).__name__)
def test_an_error_reaches_another_process_as_it_was_raised(raised: Exception) -> None:
    arrived = pickle.loads(pickle.dumps(raised))  # noqa: S301 - our own bytes
    assert type(arrived) is type(raised)
    assert str(arrived) == str(raised)
    assert vars(arrived) == vars(raised)
