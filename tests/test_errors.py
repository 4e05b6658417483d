"""An error that ends a trial reaches the process that asked for it as it was raised: pools and Dask
send it with pickle, which calls the class with `args`."""

from __future__ import annotations

import pickle

import pytest

from petrobot.coordinator.analysis.formats.netfile import NetFileError
from petrobot.coordinator.run.mission import MissionError
from petrobot.coordinator.run.realtime import UnreachableError
from petrobot.coordinator.task.conditions.language import ConditionError
from petrobot.coordinator.task.elements import Kind, Place
from petrobot.coordinator.task.expansion import CircleError
from petrobot.coordinator.task.file.errors import TaskFileError
from petrobot.coordinator.task.wording import Fault
from petrobot.services.action import CallFailed, error
from petrobot.services.comm.location_file import DirectoryError
from petrobot.services.comm.lockstep.mesh import PartyLostError

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
]


@pytest.mark.parametrize("raised", RAISED, ids=lambda raised: type(raised).__name__)
def test_an_error_reaches_another_process_as_it_was_raised(raised: Exception) -> None:
    arrived = pickle.loads(pickle.dumps(raised))  # noqa: S301 - our own bytes
    assert type(arrived) is type(raised)
    assert str(arrived) == str(raised)
    assert vars(arrived) == vars(raised)
