"""Conditions: language, positions of faults, kinds, and exclusivity and coverage against brute
force."""

from __future__ import annotations

from itertools import product
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st

from petrobot.coordinator.task.conditions import (
    Certainty,
    ConditionError,
    ConditionFault,
    Domain,
    covering,
    equivalent,
    exclusive,
    kind_faults,
    parse,
    rename,
)

VALUES = {"a": True, "b": False, "n": 3, "x": 2.5, "s": "line", "p.reason": "lost", "u": None}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a", True),
        ("not a", False),
        ("not not a", True),
        ("a and b", False),
        ("a or b and b", True),
        ("(a or b) and b", False),
        ("n == 3", True),
        ("n == 3.0", True),
        ("3 < n", False),
        ("n >= 3 and n <= 3", True),
        ("x > -1.5e1", True),
        ("s == 'line'", True),
        ('s != "line"', False),
        ("p.reason == 'lost'", True),
        ("u == none", True),
        ("n != none", True),
        ("a == true", True),
        ("n == true", False),
        ("true", True),
        ("a == (n > 2)", True),
        ("not n == 3", False),
    ],
)
def test_value(text: str, expected: bool) -> None:
    assert parse(text).holds(VALUES) is expected


@pytest.mark.parametrize(
    ("text", "column", "words"),
    [
        ("", 1, "empty"),
        ("   ", 1, "empty"),
        ("a and", 6, "missing"),
        ("a = b", 3, "written =="),
        ("a & b", 3, "write and"),
        ("a b", 3, "not expected"),
        ("1 < n < 3", 7, "one comparison"),
        ("(a or b", 1, "not closed"),
        ("a)", 2, "not expected"),
        ("s == 'line", 6, "string is not closed"),
        ("and a", 1, "neither a value nor a name"),
        ("n > 1e999", 5, "too large"),
        ("n > " + "9" * 50, 5, "more than 40"),
        ("a ;", 3, "no meaning"),
        ("n + 1 > 2", 3, "no meaning"),
        ("f(a)", 2, "not expected"),
        ("(" * 60 + "a" + ")" * 60, 51, "deep"),
    ],
)
def test_fault_with_its_position(text: str, column: int, words: str) -> None:
    with pytest.raises(ConditionError) as caught:
        parse(text)
    assert caught.value.at + 1 == column and words in str(caught.value)


@pytest.mark.parametrize(
    "text", ["n", "u", "not n", "a and n", "s > 1", "u < 1", "a < 1", "missing", "n and a"]
)
def test_no_truth_value(text: str) -> None:
    with pytest.raises(ConditionFault):
        parse(text).holds(VALUES)


def test_names_and_renaming() -> None:
    condition = parse("a and (p.reason == 'a' or not a)")
    assert condition.names == {"a", "p.reason"}
    assert (
        rename(condition, {"a": "m.a", "p.reason": "m.p.reason"}).text
        == "m.a and (m.p.reason == 'a' or not m.a)"
    )


DOMAINS = {
    "a": Domain("bool"),
    "n": Domain("int"),
    "x": Domain("float"),
    "y": Domain("float"),
    "s": Domain("str"),
    "k": Domain("str", ("line", "arc", "end")),
    "v": Domain("any"),
}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("b", "unknown"),
        ("nn > 1", "unknown"),
        ("n", "neither true nor false"),
        ("a and s", "neither true nor false"),
        ("s > 'a'", "only numbers"),
        ("a < 1", "only numbers"),
        ("n == 'x'", "never equal"),
        ("k == 'lin'", "did you mean 'line'"),
        ("v == 3", "never equal"),
        ("v == v", "declare their types"),
    ],
)
def test_kinds_that_never_fit(text: str, words: str) -> None:
    assert words in " ".join(kind_faults(parse(text), DOMAINS))


@pytest.mark.parametrize("text", ["a", "n > 1.5", "x < y", "k == 'arc'", "v == none", "s == k"])
def test_kinds_that_fit(text: str) -> None:
    assert kind_faults(parse(text), DOMAINS) == []


@pytest.mark.parametrize(
    ("texts", "apart", "cover"),
    [
        (["a", "not a"], True, True),
        (["n > 3", "n <= 3"], True, True),
        (["n > 3", "n < 4"], True, True),
        (["x > 3", "x < 4"], False, True),
        (["n > 3", "n < 3"], True, False),
        (["x > 0 and x < 1", "x >= 1"], True, False),
        (["n > 0 and n < 2", "n == 1"], False, False),
        (["n > 0 and n < 1"], True, False),
        (["k == 'line'", "k == 'arc'", "k == 'end'"], True, True),
        (["s == 'line'", "s == 'arc'"], True, False),
        (["s == 'line'", "s != 'line'"], True, True),
        (["x < y", "x >= y"], True, True),
        (["x < y", "y < x"], True, False),
        (["x < y", "x == y", "y < x"], True, True),
        (["x < y and y < 1", "x >= 1"], True, False),
        (["v == none", "v != none"], True, True),
        (["a and n > 0", "not a and n > 0", "n <= 0"], True, True),
    ],
)
def test_exclusive_and_covering(texts: list[str], apart: bool, cover: bool) -> None:
    conditions = [parse(t) for t in texts]
    assert (exclusive(conditions, DOMAINS).answer is Certainty.PROVED) is apart
    verdict = covering(conditions, DOMAINS)
    assert (verdict.answer is Certainty.PROVED) is cover
    if not cover:
        assert verdict.witness is not None
        assert not any(c.holds(verdict.witness) for c in conditions)


def test_too_many_regions_are_unknown() -> None:
    names = [f"x{i}" for i in range(9)]
    text = " and ".join(f"{n} > {i} and {n} < {i + 9}" for i, n in enumerate(names))
    domains = {n: Domain("float") for n in names}
    assert exclusive([parse(text), parse(f"not ({text})")], domains).answer is Certainty.UNKNOWN


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("n > 2 and b", "b  and not (n <= 2)", True),
        ("n > 2 or n <= 2", "true", False),  # without a value, no order holds
        ("n >= 3", "n > 2", True),
        ("x >= 3", "x > 2", False),
        ("n == 1", "m == 1", False),
    ],
)
def test_equal_conditions(one: str, other: str, same: bool) -> None:
    domains = {"n": Domain("int"), "m": Domain("int"), "x": Domain("float"), "b": Domain("bool")}
    assert equivalent(parse(one), parse(other), domains) is same


def test_always_true_is_never_exclusive() -> None:
    assert exclusive([None, parse("a")], DOMAINS).answer is Certainty.REFUTED
    assert covering([None], DOMAINS).answer is Certainty.PROVED


@st.composite
def conditions(draw: st.DrawFn, depth: int = 2) -> str:
    """Conditions over two booleans, two small integers and a word."""
    if depth == 0 or draw(st.booleans()):
        number = draw(st.sampled_from(("n", "m", "0", "1", "2")))
        comparison = (
            f"{draw(st.sampled_from(('n', 'm')))} "
            f"{draw(st.sampled_from(('<', '<=', '==', '!=', '>=', '>')))} {number}"
        )
        word = f"w {draw(st.sampled_from(('==', '!=')))} {draw(st.sampled_from(('1', '2')))!r}"
        return draw(st.sampled_from(("p", "q", comparison, word)))
    inner = [draw(conditions(depth - 1)) for _ in range(2)]
    return draw(
        st.sampled_from(
            (f"not ({inner[0]})", f"({inner[0]}) and ({inner[1]})", f"({inner[0]}) or ({inner[1]})")
        )
    )


SMALL = {
    "p": Domain("bool"),
    "q": Domain("bool"),
    "n": Domain("int"),
    "m": Domain("int"),
    "w": Domain("str", ("1", "2", "3")),
}
BRUTE = [
    dict(zip("pqnmw", v, strict=True))
    for v in product((True, False), (True, False), range(-2, 5), range(-2, 5), "123")
]


@settings(max_examples=100, deadline=None)
@given(st.lists(conditions(), min_size=1, max_size=3))
def test_regions_agree_with_brute_force(texts: list[str]) -> None:
    """Integers from -2 to 4 stand for all: literals lie in 0 to 2 and at most two names are
    compared."""
    parsed = [parse(t) for t in texts]
    truths: list[list[Any]] = [[c.holds(values) for c in parsed] for values in BRUTE]
    assert (exclusive(parsed, SMALL).answer is Certainty.PROVED) is all(sum(t) < 2 for t in truths)
    assert (covering(parsed, SMALL).answer is Certainty.PROVED) is all(any(t) for t in truths)


@settings(max_examples=300, deadline=None)
@given(st.text(st.sampled_from("ab()<>=! notrue.'1-e&\n"), max_size=30))
def test_any_text_gives_a_condition_or_its_fault(text: str) -> None:
    try:
        condition = parse(text)
    except ConditionError as error:
        assert 0 <= error.at <= len(text)
    else:
        assert parse(condition.text) == condition
