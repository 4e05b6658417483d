"""One trial (one run token taken out of the runs place, and everything that followed from it) as
plain data, and the observer that records it.

A *trial* is one run of a task, whatever the task does; a mission run is a whole execution and may
contain several trials. A task without a runs place has one trial per mission run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from petrobot.coordinator.engine import State
from petrobot.coordinator.engine.instructions import (
    Corrected,
    Finished,
    Fired,
    Instruction,
    Marked,
    RunRecorded,
    StartRun,
)
from petrobot.coordinator.engine.stimuli import RunEnded, Stimulus
from petrobot.coordinator.learning.records import Waited, WaitEnd
from petrobot.coordinator.learning.trial_tokens import TrialTokens
from petrobot.coordinator.learning.waits import EventWaits
