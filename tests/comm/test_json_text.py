"""JSON for other programs: a strict parser accepts the text of every value, and no other code of
the project writes JSON."""

from __future__ import annotations

import ast
import json
from fractions import Fraction
from math import inf, nan
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import numpy as np
import pytest
from hypothesis import given, strategies as st

from petrobot.services.host.json_text import finite, json_text, without_controls

ROOT = Path(__file__).parents[2]
BETWEEN_OWN_PROCESSES = {
    "coordinator/studies/campaign/pool.py",
    "coordinator/studies/campaign/worker.py",
    "coordinator/learning/estimates_tables.py",
    "services/comm/location_file/code.py",
}
"""Files that only Python reads, whose parser accepts infinity."""
FOR_A_HASH = {
    "coordinator/studies/campaign/plan.py",
    "coordinator/studies/forecast/registered.py",
    "services/comm/location_file/reading.py",
}
ADAPTERS = ROOT / "services" / "adapters"
WRITER = "services/host/json_text.py"


def strict(text: str) -> Any:
    """Parse like a browser; fail where a browser fails."""

    def refuse(token: str) -> None:
        raise AssertionError(f"no JSON: {token}")

    return json.loads(text, parse_constant=refuse)


LEAVES = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(max_size=3)
VALUES = st.recursive(
    LEAVES, lambda inner: st.lists(inner) | st.dictionaries(st.text() | st.integers(), inner)
)


@given(VALUES)
def test_a_strict_parser_reads_every_value(value: Any) -> None:
    strict(json_text(value))
    strict(json_text(value, indent=2, ensure_ascii=False))


@given(
    st.recursive(st.integers(-9, 9) | st.floats(allow_nan=False, allow_infinity=False), st.lists)
)
def test_finite_values_are_written_as_json_dumps_does(value: Any) -> None:
    assert json_text(value) == json.dumps(value)
    assert finite(value) == value


BAD = {
    "inf": inf,
    "-inf": -inf,
    "nan": nan,
    "float64": np.float64(inf),
    "float32": np.float32(nan),
    "long": 10**5000,
}


@pytest.mark.parametrize("bad", BAD.values(), ids=BAD)
def test_numbers_that_are_not_finite_become_null_at_any_depth(bad: Any) -> None:
    told = strict(json_text({"a": [1.5, {"b": (bad, "x")}], "c": bad}))
    assert told == {"a": [1.5, {"b": [None, "x"]}], "c": None}


def test_values_outside_json_become_text_or_numbers() -> None:
    ring: dict[str, Any] = {}
    ring["self"] = ring

    class Mute:
        def __str__(self) -> str:
            raise RuntimeError

    told = strict(json_text([np.float32(0.5), Fraction(1, 4), {1}, Mute(), {(1, 2): nan}, ring]))
    assert told[:4] == [0.5, 0.25, "{1}", "<Mute>"]
    assert told[4] == {"(1, 2)": None}
    deep: Any = nan
    for _ in range(5000):
        deep = [deep]
    strict(json_text(deep))


def refuses_infinity(call: ast.Call) -> bool:
    """Whether a call of `json.dumps` refuses what is not finite."""
    return any(
        k.arg == "allow_nan" and isinstance(k.value, ast.Constant) and k.value.value is False
        for k in call.keywords
    )


@pytest.mark.once
def test_no_other_code_writes_json() -> None:
    """A `json.dumps` elsewhere would be the next text with `Infinity` in it. Adapters reach only
    the public API: they refuse such numbers."""
    own = BETWEEN_OWN_PROCESSES | FOR_A_HASH | {WRITER}
    for top in ("coordinator", "services", "sim"):
        for path in sorted((ROOT / top).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            if "dump" not in text and "json_response" not in text:
                continue  # nothing to find: parsing all files takes seconds
            tree = list(ast.walk(ast.parse(text)))
            refusing = {
                node.func
                for node in tree
                if path.is_relative_to(ADAPTERS)
                and isinstance(node, ast.Call)
                and refuses_infinity(node)
            }
            calls = [
                node.lineno
                for node in tree
                if isinstance(node, ast.Attribute)
                and node.attr in ("dumps", "dump", "json_response")
                and node not in refusing
                if isinstance(node.value, ast.Name) and node.value.id in ("json", "web")
            ]
            name = path.relative_to(ROOT).as_posix()
            assert not calls or name in own, (
                f"{name}:{calls[0]}: write JSON with services.comm.json_text.json_text"
            )


@given(st.text())
def test_a_text_without_controls_is_one_that_xml_can_carry(text: str) -> None:
    """Each is replaced by one character."""
    shown = without_controls(text + "\x1b[31m\x00")
    assert ElementTree.fromstring(f"<a>{escape(shown)}</a>").tag == "a"
    assert "\x1b" not in shown and len(shown) == len(text) + 6
