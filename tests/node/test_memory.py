"""The global memory of a node, and its timers."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from petrobot.services.action import Status
from petrobot.services.node import memory as memory_module
from petrobot.services.node.memory import GlobalMemory, event_name
from petrobot.services.node.node import EventTimers

PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63)
    | st.floats(allow_nan=False)
    | st.text()
    | st.binary(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


class MemoryMachine(RuleBasedStateMachine):
    """The memory against a dictionary of (value, version), in any order of calls."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[tuple[str, Any, int]] = []
        self.memory = GlobalMemory(
            lambda name, value, version: self.told.append((name, value, version))
        )
        self.model: dict[str, tuple[Any, int]] = {}
        self.writes = 0

    def _wrote(self, name: str, value: Any) -> None:
        self.model[name] = (value, self.model.get(name, (None, 0))[1] + 1)
        self.writes += 1
        assert self.told[-1] == (name, *self.model[name])

    @rule(name=st.sampled_from("abc"), value=PLAIN)
    def put(self, name: str, value: Any) -> None:
        result = self.memory.call("memory.put", {"name": name, "value": value})
        self._wrote(name, value)
        assert result.values == {"version": self.model[name][1]}

    @rule(name=st.sampled_from("abc"), version=st.integers(0, 4), value=PLAIN)
    def compare_and_set(self, name: str, version: int, value: Any) -> None:
        current = self.model.get(name, (None, 0))
        result = self.memory.call(
            "memory.compare_and_set", {"name": name, "version": version, "value": value}
        )
        if version == current[1]:
            self._wrote(name, value)
            assert result.status is Status.SUCCESS
        else:
            assert (result.status, result.cause) == (Status.FAILURE, "changed")
            assert (result.values["value"], result.values["version"]) == current

    @rule(name=st.sampled_from("abc"))
    def get(self, name: str) -> None:
        value, version = self.model.get(name, (None, 0))
        assert self.memory.call("memory.get", {"name": name}).values == {
            "value": value,
            "version": version,
        }

    @invariant()
    def every_change_is_told_once(self) -> None:
        assert len(self.told) == self.writes
        listed = self.memory.call("memory.list", {}).values["versions"]
        assert listed == {name: version for name, (_, version) in sorted(self.model.items())}


TestMemory = MemoryMachine.TestCase
TestMemory.settings = settings(max_examples=25, stateful_step_count=25, deadline=None)


@pytest.mark.parametrize(
    ("service", "arguments", "cause", "says"),
    [
        ("memory.get", {}, "bad_arguments", "name"),
        ("memory.get", {"name": ""}, "bad_arguments", "give a text of 1 to 200 characters"),
        ("memory.get", {"name": 3}, "bad_arguments", "give a text"),
        ("memory.put", {"name": "x"}, "bad_arguments", "value"),
        ("memory.put", {"name": "x", "value": 1, "force": True}, "bad_arguments", "force"),
        (
            "memory.compare_and_set",
            {"name": "x", "version": "1", "value": 1},
            "bad_arguments",
            "memory.get returned",
        ),
        ("memory.put", {"name": "x", "value": bytes(1 << 21)}, "too_large", "the limit is 1048576"),
    ],
)
def test_the_memory_refuses(service: str, arguments: dict[str, Any], cause: str, says: str) -> None:
    result = GlobalMemory(lambda *_: None).call(service, arguments)
    assert (result.status, result.cause) == (Status.ERROR, cause) and says in result.text


def test_the_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_module, "VARIABLES", 3)
    monkeypatch.setattr(memory_module, "TOTAL_BYTES", 1000)
    memory = GlobalMemory(lambda *_: None)
    for name in "abc":
        assert (
            memory.call("memory.put", {"name": name, "value": bytes(300)}).status is Status.SUCCESS
        )
    assert memory.call("memory.put", {"name": "d", "value": 1}).cause == "memory_full"
    assert memory.call("memory.put", {"name": "a", "value": bytes(600)}).cause == "memory_full"
    assert memory.call("memory.put", {"name": "a", "value": bytes(200)}).values == {"version": 2}
    assert event_name("a") == "memory:a"


@given(
    period=st.floats(0.004, 1.0),
    steps=st.lists(st.floats(0.001, 0.5), min_size=1, max_size=60),
)
def test_timers_lie_on_an_absolute_grid(period: float, steps: list[float]) -> None:
    timers, now, fired = EventTimers({"beat": period}), 10.0, 0
    timers.advance(now)
    for step in steps:
        now += step
        fired += len(timers.advance(now))
        due = timers.due()
        assert due is not None and now < due + 1e-5 <= now + period + 2e-5
        assert math.isclose((due - 10.0) / period, round((due - 10.0) / period), abs_tol=1e-4), (
            "it left its grid"
        )
    assert fired <= (now - 10.0) / period + 1e-3, "a pulse too many"
    if max(steps) < period:
        assert fired == math.floor((now - 10.0) / period + 1e-6) or math.isclose(
            (now - 10.0) / period, round((now - 10.0) / period), abs_tol=1e-3
        )


def test_unknown_timers_are_refused() -> None:
    timers = EventTimers({})
    assert timers.advance(1.0) == [] and timers.due() is None
