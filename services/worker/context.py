"""The context of one run: everything outside that an action can use."""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from petrobot.services.action import CallFailed, CommandRefused, Result, Status, Wait
from petrobot.services.comm.calls.events import RunVerdict, mission_of, verdict_event
from petrobot.services.comm.protocol.codec import (
    EXECUTED,
    LIMITS,
    NAME_LENGTH,
    ProtocolError,
    encode,
)
from petrobot.services.comm.protocol.messages import (
    Answer,
    Call,
    Cancel,
    Event,
    Executed,
    Feedback,
    Message,
    Outcome,
)
from petrobot.services.comm.protocol.plain import plain
from petrobot.services.worker.callables import describe, from_outside, words_of
from petrobot.services.worker.setpoints import Outlets, Sent

Report = Outcome | Feedback | Event | Call | Cancel | Answer | Sent
"""What a host of runs tells its node. Outcome: the result of a run. Feedback: its progress. Event:
one of a run, a verdict on an earlier run, or an external one of the device. Call: a run (`parent`)
calls a service. Cancel: a run no longer waits for a call that it made. Answer: that of a command,
with a word as `answer` in its data. Sent: a set point leaves (in lock step only)."""

if TYPE_CHECKING:
    import numpy as np


def never() -> bool:
    """What a run waits for that only waits for time."""
    return False


def checked(message: Message) -> None:
    """Refuse a message that no peer would accept, where it is made: later it could only cost the
    connection. Raises ValueError."""
    try:
        encode(message)
    except ProtocolError as fault:
        raise ValueError(fault.text) from None


def outcome_of(identity: str, result: Result) -> Outcome:
    """Return the result of a call as the message that carries it."""
    said = (result.status, result.values, result.cause, result.text)
    return Outcome(identity, *said, Executed(result.executed), deferred=result.deferred)


def result_of(outcome: Outcome) -> Result:
    """Return the result that a message carries."""
    return Result(
        Status(outcome.status),
        outcome.values,
        outcome.cause,
        outcome.text,
        outcome.deferred,
        outcome.executed,
    )


def checked_result(identity: str, returned: Any, where: str = "result") -> Outcome:
    """Return what an action or a service returned as an outcome of plain data that can be sent.
    Raises ValueError if that is impossible; `where` names the values in its text."""
    try:
        if inspect.iscoroutine(returned):
            returned.close()  # else Python would warn of it
            name = returned.__name__
            raise ValueError(
                f"returned {name}(...) without `await`; write `return await {name}(...)`"
            )
        if not isinstance(returned, Result):
            name = type(returned).__name__
            raise ValueError(f"returned a {name}; return success(), failure() or error()")
        values = plain(returned.values, where)
        if type(values) is not dict:
            raise ValueError(f"{where}: expected values by name, found a {type(values).__name__}")
        _refuse_large(values, where)
        cause = "" if returned.cause is None else plain(str(returned.cause))
        text = "" if returned.text is None else plain(str(returned.text))
        # Most are members already: to make one of its text takes 1 us.
        status = returned.status if type(returned.status) is Status else Status(returned.status)
        executed = EXECUTED.get(returned.executed) or Executed(returned.executed)
        result = Outcome(
            identity, status, values, cause, text, executed, deferred=bool(returned.deferred)
        )
        checked(result)
    except (TypeError, ValueError, MemoryError) as fault:
        raise ValueError(words_of(fault) or type(fault).__name__) from None
    except BaseException as fault:  # the value's own code: an object may raise what it likes
        if from_outside(fault):
            raise
        raise ValueError(f"its values cannot be read: {describe(fault)}") from None
    return result


def _refuse_large(values: Mapping[str, Any], where: str) -> None:
    """Raise ValueError for a text or bytes that alone are too large for a result. To encode them
    first, only to refuse them then, would hold a node whose service returns them."""
    for name, value in values.items():
        if type(value) in (bytes, str) and len(value) > LIMITS[Outcome.KIND]:
            raise ValueError(
                f"{where}.{name}: {len(value):,} bytes are above its limit of "
                f"{LIMITS[Outcome.KIND]:,}; store them in a file and give its name"
            )


class Draws:
    """The random generators of one owner (a run, a device) by purpose, keyed by (seed, owner,
    purpose)."""

    def __init__(self, owner: str, seed: int | None = None) -> None:
        self._owner = owner
        self._seed = seed
        self._generators: dict[str, np.random.Generator] = {}

    def reseed(self, seed: int) -> None:
        """Start new generators if this is another seed: that of the mission run whose action
        begins."""
        if seed != self._seed:
            self._seed = seed
            self._generators.clear()

    def random(self, purpose: str) -> np.random.Generator:
        """Return the generator of a purpose; asking again continues with the same one.

        Raises ValueError before there is a seed.
        """
        if self._seed is None:
            raise ValueError(
                f"random({purpose!r}): a driver is made before the seed is known; draw where it is "
                "needed, in `step`, `command` or a method of its own"
            )
        if purpose not in self._generators:
            key = f"{self._seed}\0{self._owner}\0{purpose}".encode()
            import numpy as np  # here: most actions draw nothing, and importing it takes 0.1 s

            words = np.frombuffer(hashlib.sha256(key).digest(), dtype="<u4")
            self._generators[purpose] = np.random.default_rng([int(w) for w in words])
        return self._generators[purpose]


class RunContext:
    """Implements `services.action.Context` for one run of a `Runner`."""

    def __init__(
        self,
        call: Call,
        device: Any,
        clock: Callable[[], float],
        outlets: Outlets,
        report: Callable[[Report], None],
    ) -> None:
        self.held = 0.0
        """How long the operator has held the run (s)."""
        self._call = call
        self._device = device
        self._clock = clock
        self._began = clock()
        self._outlets = outlets
        self._report = report
        self._children = 0
        self._answers: dict[str, Result] = {}
        self._waiting: set[str] = set()
        self._draws = Draws(call.id, call.seed)

    @property
    def now(self) -> float:
        """The cell's clock, without the time for which the run was held (s)."""
        return self._clock() - self.held

    @property
    def run(self) -> str:
        """This run's id."""
        return self._call.id

    @property
    def device(self) -> Any:
        """The handle of the action's device, None without one."""
        return self._device

    def wait(self, ready: Callable[[], bool], timeout: float | None = None) -> Wait:
        """Awaitable: True as soon as `ready()` holds, False after `timeout` seconds."""
        given: object = ready
        if not callable(given):
            text = "ctx.wait: expected a function, as in `ctx.wait(lambda: ...)`"
            raise TypeError(f"{text}, found {given!r:.60}")
        return Wait(ready, None if timeout is None else self._after("wait", timeout))

    def sleep(self, seconds: float) -> Wait:
        """Awaitable: returns after this number of seconds of the cell's clock."""
        return Wait(never, self._after("sleep", seconds))

    def _after(self, call: str, seconds: float) -> float:
        given: object = seconds
        if not isinstance(given, Real) or given != given:
            raise ValueError(f"ctx.{call}: expected a number of seconds, found {given!r:.60}")
        return self._clock() + seconds

    def publish(self, stream: str, values: Sequence[float]) -> None:
        """Make `values` the newest set point of a stream. It is sent repeatedly until the run ends
        or withdraws it."""
        self._outlets.publish(self._clock(), self.run, self._began, stream, values)

    def withdraw(self, stream: str) -> None:
        """Withdraw the last set point of a stream."""
        self._outlets.withdraw(stream, self.run)

    def raise_event(self, name: str, **data: Any) -> None:
        """Raise a named internal event during the run."""
        event = Event(
            plain(name, "name"), self._call.service, 0, plain(data, "data"), self._call.id
        )
        checked(event)
        self._report(event)

    def verdict(self, run: str, result: Result) -> None:
        """Give the verdict on an earlier run that ended provisionally. Raises ValueError if the id
        is not one."""
        try:
            said = RunVerdict(run, Status(result.status).value, str(result.cause), str(result.text))
        except AttributeError:
            wanted = 'a result, such as success() or failure("cause", "text")'
            raise TypeError(f"verdict: expected {wanted}, found {result!r:.60}") from None
        name = verdict_event(mission_of(run))
        checked(Outcome(run, said.status, cause=said.cause, text=said.text))
        event = Event(name, self._call.service, 0, said.to_data())
        checked(event)
        self._report(event)

    def progress(self, fraction: float, **data: Any) -> None:
        """Report the progress of the run, 0 to 1 (clipped)."""
        if not math.isfinite(fraction):
            raise ValueError(f"progress is {fraction}; give a number from 0 to 1")
        feedback = Feedback(self.run, min(1.0, max(0.0, float(fraction))), plain(data, "data"))
        checked(feedback)
        self._report(feedback)

    async def call(
        self, service: str, /, deadline: float | None = None, **arguments: Any
    ) -> Result:
        """Call any network service by its name. A call that is open when the run is cancelled is
        cancelled, too. Raises ValueError or TypeError for arguments that cannot be sent."""
        self._children += 1
        child = f"{self.run}/{self._children}"
        limit = None if deadline is None else float(deadline)
        asked = Call(
            child,
            plain(service, "service"),
            plain(arguments, "arguments"),
            limit,
            parent=self.run,
            seed=self._call.seed,
        )
        # The node adds the boot of its peer: as long as any name of it, so that what passes here
        # passes there.
        checked(replace(asked, boot="b" * NAME_LENGTH))
        self._report(asked)
        self._waiting.add(child)
        try:
            await Wait(lambda: child in self._answers)
        finally:
            self._waiting.discard(child)
            if child not in self._answers:
                self._report(Cancel(child, "its run no longer waits"))
        return self._answers.pop(child)

    async def command(
        self, body: Mapping[str, Any], timeout: float = 1.0, *, until: str = ""
    ) -> Mapping[str, Any]:
        """Send a command to the device's driver, and wait until the driver has accepted it, and
        until `device.state[until]` is true. Return the state then. Raises CommandRefused."""
        device = self._device
        if not hasattr(device, "send"):
            action = self._call.service
            raise CommandRefused(
                f'{action!r} runs without a device: write device = "..." in [actions.{action}] of '
                "services.toml"
                if device is None
                else f"the driver of {action!r} takes no commands, because it has no `period`: "
                "call its methods, as in ctx.device.read()"
            )
        number = device.send(body)
        if not await self.wait(lambda: device.handled >= number, timeout):
            raise CommandRefused(f"the driver did not take {dict(body)} within {timeout:g} s")
        if refused := device.refused:
            raise CommandRefused(refused)
        state: Mapping[str, Any] = device.state
        if until and until not in state:
            known = ", ".join(map(repr, state)) or "nothing"
            raise ValueError(f"until: the state of the driver has no {until!r}; it has {known}")
        await self.wait(lambda: not until or bool(device.state[until]))
        return dict(device.state)

    async def get(self, name: str, default: Any = None) -> Any:
        """Read a global-memory variable; `default` if it was never written. Raises CallFailed."""
        return (await self.get_versioned(name, default))[0]

    async def get_versioned(self, name: str, default: Any = None) -> tuple[Any, int]:
        """Read a variable with its version, 0 and `default` if it was never written. Raises
        CallFailed."""
        values = (await self._memory("memory.get", name=name)).values
        # A stand-in for the memory in a test may leave the version out.
        version = values.get("version", 1)
        return (values.get("value"), int(version)) if version else (default, 0)

    async def put(self, name: str, value: Any) -> int:
        """Write a global-memory variable, and return its new version. Raises CallFailed."""
        return int((await self._memory("memory.put", name=name, value=value)).values["version"])

    async def compare_and_set(self, name: str, version: int, value: Any) -> bool:
        """Write a variable if its version is still the given one (0: never written). Raises
        CallFailed."""
        result = await self._memory(
            "memory.compare_and_set", name=name, version=version, value=value
        )
        return result.status is Status.SUCCESS

    async def _memory(self, service: str, **arguments: Any) -> Result:
        result = await self.call(service, None, **arguments)
        if result.status is Status.ERROR:
            raise CallFailed(service, result)
        return result

    def random(self, purpose: str) -> np.random.Generator:
        """Return the generator of (seed, run, purpose); asking again continues with the same
        one."""
        return self._draws.random(purpose)

    def answer(self, outcome: Outcome) -> bool:
        """Accept the result of a call that this run made. Return False if the run does not wait for
        it."""
        if outcome.id not in self._waiting:
            return False
        # A verdict on a provisional answer names the run that gave it, never this one.
        self._answers[outcome.id] = dataclasses.replace(result_of(outcome), deferred=False)
        return True
