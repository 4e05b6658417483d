"""Executes a task's Petri net as a pure state machine: stimulus in, instructions out.

docs/semantics.md defines what it does."""

from petrobot.coordinator.engine.instructions import (
    ArmTimer as ArmTimer,
    CancelRun as CancelRun,
    Choose as Choose,
    Corrected as Corrected,
    DisarmTimer as DisarmTimer,
    Finished as Finished,
    Fired as Fired,
    HoldRun as HoldRun,
    HoldTimer as HoldTimer,
    Instruction as Instruction,
    Marked as Marked,
    Paused as Paused,
    ReleaseRun as ReleaseRun,
    ReleaseTimer as ReleaseTimer,
    Report as Report,
    Resumed as Resumed,
    RunRecorded as RunRecorded,
    StartRun as StartRun,
    Subject as Subject,
)
from petrobot.coordinator.engine.machine import Engine as Engine
from petrobot.coordinator.engine.serialization import (
    point_from_plain as point_from_plain,
    stimulus_from_plain as stimulus_from_plain,
    to_plain as to_plain,
)
from petrobot.coordinator.engine.state import (
    Mode as Mode,
    Phase as Phase,
    Run as Run,
    State as State,
    Timer as Timer,
)
from petrobot.coordinator.engine.step import Policy as Policy
from petrobot.coordinator.engine.stimuli import (
    Abort as Abort,
    AddTokens as AddTokens,
    Begin as Begin,
    Chosen as Chosen,
    EventOccurred as EventOccurred,
    ForceExit as ForceExit,
    Hold as Hold,
    Override as Override,
    Pause as Pause,
    Point as Point,
    RaiseEvent as RaiseEvent,
    RemoveTokens as RemoveTokens,
    Resume as Resume,
    RunEnded as RunEnded,
    RunHeld as RunHeld,
    RunRaised as RunRaised,
    RunStarted as RunStarted,
    SetBreakpoints as SetBreakpoints,
    Standing as Standing,
    Step as Step,
    Stimulus as Stimulus,
    StopConfirmed as StopConfirmed,
    StopFailed as StopFailed,
    TimerFired as TimerFired,
    VariableChanged as VariableChanged,
    Verdict as Verdict,
)
from petrobot.coordinator.task.wording import Severity as Severity
