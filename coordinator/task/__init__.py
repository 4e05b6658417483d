"""The robotic task model: records, the expansion of macro places, and what every task must satisfy
to mean something."""

from petrobot.coordinator.task.elements import (
    Counts as Counts,
    EarlyEvent as EarlyEvent,
    End as End,
    Estimate as Estimate,
    Event as Event,
    EventMemory as EventMemory,
    Executed as Executed,
    Inhibitor as Inhibitor,
    Input as Input,
    Kind as Kind,
    Output as Output,
    Parameter as Parameter,
    Place as Place,
    PrimitiveTask as PrimitiveTask,
    Reference as Reference,
    Scope as Scope,
    Start as Start,
    Status as Status,
    Subnet as Subnet,
    Transition as Transition,
    Value as Value,
    Variable as Variable,
    VariableType as VariableType,
)
from petrobot.coordinator.task.model import Task as Task
