"""Conditions: a small expression language over named values, parsed into an immutable tree.

    expression  = conjunction { "or" conjunction }
    conjunction = negation { "and" negation }
    negation    = "not" negation | comparison
    comparison  = operand [ ( "==" | "!=" | "<" | "<=" | ">" | ">=" ) operand ]
    operand     = number | string | "true" | "false" | "none" | name { "." name } | "(" expression
                ")"

There is no arithmetic, no call and no truth value but true and false: a condition that meets a
value of another kind has no truth value and says so with `ConditionFault`. Equality is by kind (1
is not true); order is for numbers alone.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import isfinite
from typing import Any

from msgspec import Struct

Scalar = None | bool | int | float | str
COMPARISONS = ("==", "!=", "<=", ">=", "<", ">")
_WORDS: Mapping[str, Scalar] = {"true": True, "false": False, "none": None}
_TOKEN = re.compile(
    r"""\s*(?:
        (?P<number>-?(?:\d+\.\d*|\.\d+|\d+)(?:[eE][+-]?\d+)?)
      | (?P<string>"[^"]*"|'[^']*')
      | (?P<name>[^\W\d]\w*(?:\.[^\W\d]\w*)*)
      | (?P<sign>==|!=|<=|>=|<|>|\(|\))
    )""",
    re.VERBOSE,
)
_DEPTH = 50
_DIGITS = 40


class ConditionError(ValueError):
    """The text is not a condition. `at` is the position of the fault in `source`, from 0."""

    def __init__(self, text: str, source: str, at: int) -> None:
        super().__init__(text, source, at)
        self.text = text
        self.source = source
        self.at = at

    def __str__(self) -> str:
        return f"{self.text} at column {self.at + 1} of {self.source!r}"


class ConditionFault(Exception):  # noqa: N818 - not a bug: these values give the condition no truth value
    """A condition has no truth value for the present values (a name was never written, or holds a
    value of another type)."""


@dataclass(frozen=True, slots=True)
class Literal:
    """A value written in the condition."""

    value: Scalar
    at: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True)
class Name:
    """A value looked up when the condition is judged."""

    name: str
    at: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True)
class Compare:
    """Two operands compared."""

    sign: str
    left: Node
    right: Node
    at: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True)
class Not:
    """Negation."""

    operand: Node
    at: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True)
class And:
    """All operands hold."""

    operands: tuple[Node, ...]
    at: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True)
class Or:
    """At least one operand holds."""

    operands: tuple[Node, ...]
    at: int = field(default=0, compare=False)


Node = Literal | Name | Compare | Not | And | Or


class Expression(Struct, frozen=True, dict=True):
    """A parsed condition; two are equal when their texts are."""

    text: str
    tree: Node = field(compare=False, repr=False)

    @cached_property
    def names(self) -> frozenset[str]:
        """All names that the condition reads."""
        return frozenset(n.name for n in walk(self.tree) if isinstance(n, Name))

    def value(self, values: Mapping[str, Any]) -> Any:
        """The value of a literal or a name. Raises ConditionFault for a name that is unknown."""
        return _value(self.tree, values)

    def holds(self, values: Mapping[str, Any]) -> bool:
        """Whether the condition is true for the values. Raises ConditionFault when it has no truth
        value."""
        return _truth(_value(self.tree, values), self.tree)

    def __str__(self) -> str:
        return self.text


def parse(text: str) -> Expression:
    """The condition written in the text. Raises ConditionError with the exact position of the
    fault."""
    return Expression(text, _Parser(text).whole())


def as_literal(value: object) -> str:
    """Return a value as a condition writes it: `true` and not `True`."""
    return next((word for word, known in _WORDS.items() if known is value), repr(value))


def rename(expression: Expression, names: Mapping[str, str]) -> Expression:
    """The same condition with other names in place of those in the mapping."""
    text, end = "", 0
    for node in sorted(
        (n for n in walk(expression.tree) if isinstance(n, Name)), key=lambda n: n.at
    ):
        text += expression.text[end : node.at] + names.get(node.name, node.name)
        end = node.at + len(node.name)
    return parse(text + expression.text[end:])


def with_values(expression: Expression, values: Mapping[str, Any]) -> Expression:
    """Return the condition with literals in place of the names in the mapping."""
    return Expression(expression.text, _with_values(expression.tree, values))


def _with_values(node: Node, values: Mapping[str, Any]) -> Node:
    if isinstance(node, Name):
        return Literal(values[node.name], node.at) if node.name in values else node
    if isinstance(node, Not):
        return Not(_with_values(node.operand, values), node.at)
    if isinstance(node, And | Or):
        return type(node)(tuple(_with_values(part, values) for part in node.operands), node.at)
    if isinstance(node, Compare):
        left, right = _with_values(node.left, values), _with_values(node.right, values)
        return Compare(node.sign, left, right, node.at)
    return node


def walk(node: Node) -> Iterator[Node]:
    """The node and all nodes below it."""
    yield node
    for child in children(node):
        yield from walk(child)


def children(node: Node) -> tuple[Node, ...]:
    """The nodes directly below a node."""
    if isinstance(node, And | Or):
        return node.operands
    if isinstance(node, Not):
        return (node.operand,)
    if isinstance(node, Compare):
        return (node.left, node.right)
    return ()


def equal(left: Any, right: Any) -> bool:
    """Equality by kind: a bool equals a bool only, numbers equal by value."""
    if isinstance(left, bool) or isinstance(right, bool):
        return left is right
    return bool(left == right)


def is_number(value: Any) -> bool:
    """Whether a value is an int or a float (a bool is neither)."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def order(left: Any, right: Any, sign: str) -> bool:
    """`left sign right` for two numbers. Raises ConditionFault for anything else."""
    if not (is_number(left) and is_number(right)):
        raise ConditionFault(
            f"{left!r} {sign} {right!r} has no truth value: only numbers are ordered"
        )
    if sign == "<":
        return bool(left < right)
    if sign == "<=":
        return bool(left <= right)
    return bool(left > right) if sign == ">" else bool(left >= right)


def _value(node: Node, values: Mapping[str, Any]) -> Any:
    if isinstance(node, Literal):
        return node.value
    if isinstance(node, Name):
        try:
            return values[node.name]
        except KeyError:
            raise ConditionFault(f"nothing is known of {node.name!r}") from None
    if isinstance(node, Not):
        return not _truth(_value(node.operand, values), node.operand)
    if isinstance(node, And):
        return all(_truth(_value(part, values), part) for part in node.operands)
    if isinstance(node, Or):
        return any(_truth(_value(part, values), part) for part in node.operands)
    left, right = _value(node.left, values), _value(node.right, values)
    if node.sign == "==":
        return equal(left, right)
    if node.sign == "!=":
        return not equal(left, right)
    return order(left, right, node.sign)


def _truth(value: Any, node: Node) -> bool:
    if isinstance(value, bool):
        return value
    what = repr(node.name) if isinstance(node, Name) else "an operand"
    raise ConditionFault(f"{what} is {value!r}, neither true nor false")


class _Parser:
    """Recursive descent over the tokens of one text."""

    def __init__(self, source: str) -> None:
        self.source = source
        self.tokens = list(_tokens(source))
        self.next = 0
        self.depth = 0

    def whole(self) -> Node:
        if len(self.tokens) == 1:
            raise ConditionError("an empty condition", self.source, 0)
        tree = self.disjunction()
        kind, text, at = self.tokens[self.next]
        if kind != "end":
            raise self.fault(
                f"{text!r} is not expected here (one comparison may not follow another; use "
                "and / or)",
                at,
            )
        return tree

    def disjunction(self) -> Node:
        return self.chain("or", self.conjunction, Or)

    def conjunction(self) -> Node:
        return self.chain("and", self.negation, And)

    def chain(self, word: str, part: Any, make: type[And] | type[Or]) -> Node:
        at = self.tokens[self.next][2]
        operands = [part()]
        while self.accept(word):
            operands.append(part())
        return operands[0] if len(operands) == 1 else make(tuple(operands), at)

    def negation(self) -> Node:
        at = self.tokens[self.next][2]
        if not self.accept("not"):
            return self.comparison()
        self.deeper(at)
        node = Not(self.negation(), at)
        self.depth -= 1
        return node

    def comparison(self) -> Node:
        left = self.operand()
        kind, text, at = self.tokens[self.next]
        if kind != "sign" or text not in COMPARISONS:
            return left
        self.next += 1
        return Compare(text, left, self.operand(), at)

    def operand(self) -> Node:
        kind, text, at = self.tokens[self.next]
        self.next += 1
        if kind == "number":
            return Literal(self.number(text, at), at)
        if kind == "string":
            return Literal(text[1:-1], at)
        if kind == "name" and text in _WORDS:
            return Literal(_WORDS[text], at)
        if kind == "name" and text not in ("and", "or", "not"):
            return Name(text, at)
        if text == "(":
            return self.parenthesis(at)
        self.next -= 1
        raise self.fault(
            "a value or a name is missing"
            if kind == "end"
            else f"{text!r} is neither a value nor a name",
            at,
        )

    def number(self, text: str, at: int) -> int | float:
        if len(text) > _DIGITS:
            raise self.fault(f"a number of more than {_DIGITS} characters", at)
        value = float(text) if set(text) & set(".eE") else int(text)
        if isinstance(value, float) and not isfinite(value):
            raise self.fault(f"{text} is too large a number", at)
        return value

    def parenthesis(self, at: int) -> Node:
        self.deeper(at)
        node = self.disjunction()
        if not self.accept(")"):
            raise self.fault("this parenthesis is not closed", at)
        self.depth -= 1
        return node

    def deeper(self, at: int) -> None:
        self.depth += 1
        if self.depth > _DEPTH:
            raise self.fault(f"nested more than {_DEPTH} deep", at)

    def accept(self, text: str) -> bool:
        kind, found, _ = self.tokens[self.next]
        if kind in ("name", "sign") and found == text:
            self.next += 1
            return True
        return False

    def fault(self, text: str, at: int) -> ConditionError:
        return ConditionError(text, self.source, at)


def _tokens(source: str) -> Iterator[tuple[str, str, int]]:
    """(kind, text, position) of each token, then ("end", "", length)."""
    at = 0
    while source[at:].strip():
        match = _TOKEN.match(source, at)
        if match is None or match.lastgroup is None:
            start = at + len(source[at:]) - len(source[at:].lstrip())
            raise ConditionError(_explain(source[start]), source, start)
        yield match.lastgroup, match[match.lastgroup], match.start(match.lastgroup)
        at = match.end()
    yield "end", "", len(source)


def _explain(sign: str) -> str:
    hints = {
        "=": "comparison is written ==",
        "&": "write and",
        "|": "write or",
        "!": "write not, or != to compare",
        **dict.fromkeys(
            "+-*/%", "it compares, and computes nothing; let an action return the number by `out`"
        ),
    }
    if sign in "\"'":
        return "this string is not closed"
    return f"{sign!r} has no meaning in a condition" + (
        f" ({hints[sign]})" if sign in hints else "; leave it out"
    )
