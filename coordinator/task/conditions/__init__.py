"""Conditions of tasks: the expression language, what can be proved about sets of conditions, and
how faults are worded."""

from petrobot.coordinator.task.conditions.language import (
    And,
    Compare,
    ConditionError,
    ConditionFault,
    Expression,
    Literal,
    Name,
    Node,
    Not,
    Or,
    parse,
    rename,
    walk,
)
from petrobot.coordinator.task.conditions.regions import (
    Certainty,
    Decision,
    Domain,
    covering,
    equivalent,
    exclusive,
    kind_faults,
)
from petrobot.coordinator.task.wording import Fault, Severity

__all__ = [
    "And",
    "Certainty",
    "Compare",
    "ConditionError",
    "ConditionFault",
    "Decision",
    "Domain",
    "Expression",
    "Fault",
    "Literal",
    "Name",
    "Node",
    "Not",
    "Or",
    "Severity",
    "covering",
    "equivalent",
    "exclusive",
    "kind_faults",
    "parse",
    "rename",
    "walk",
]
