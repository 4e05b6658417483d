"""Conditions of tasks: the expression language, what can be proved about sets of conditions, and
how faults are worded."""

from petrobot.coordinator.task.conditions.language import (
    And as And,
    Compare as Compare,
    ConditionError as ConditionError,
    ConditionFault as ConditionFault,
    Expression as Expression,
    Literal as Literal,
    Name as Name,
    Node as Node,
    Not as Not,
    Or as Or,
    parse as parse,
    rename as rename,
    walk as walk,
)
from petrobot.coordinator.task.conditions.regions import (
    Certainty as Certainty,
    Decision as Decision,
    Domain as Domain,
    covering as covering,
    equivalent as equivalent,
    exclusive as exclusive,
    kind_faults as kind_faults,
)
from petrobot.coordinator.task.wording import Fault as Fault, Severity as Severity
