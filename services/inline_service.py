"""A general-purpose service written as a plain function, answered on the spot in the node's
loop."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from petrobot.services.action import Status
from petrobot.services.callables import check_arguments, describe, from_outside
from petrobot.services.comm.callee import Inline
from petrobot.services.comm.directory import ServiceEntry, resolve
from petrobot.services.comm.messages import Call, Executed, Outcome
from petrobot.services.context import RunContext, checked_result
from petrobot.services.execution import Hung
from petrobot.services.outlets import Outlets
from petrobot.services.runs import Begin, Judged, Raised, Report

EventSink = Callable[[str, str, Mapping[str, Any]], None]
"""Takes (service, event, data) of an event that a service raises."""
VerdictSink = Callable[[str, Judged], None]
"""Takes (service, verdict) of a verdict that a service gives on an earlier run."""


def inline_service(service: ServiceEntry, raised: EventSink, judged: VerdictSink) -> Inline:
    """The callee's end of such a service. Raises ImportError when its function cannot be loaded.

    The function takes a context and keyword arguments like an action; of its context it may use
    what does not wait.
    """
    function = resolve(service.run)

    def report(told: Report) -> None:
        if isinstance(told, Raised):
            raised(service.name, told.name, told.data)
        elif isinstance(told, Judged):
            judged(service.name, told)

    def answer(now: float, call: Call) -> Outcome:
        context = RunContext(
            Begin(call.id, service.name, call.arguments), None, lambda: now, Outlets({}), report
        )
        try:
            check_arguments(function, call.arguments)
        except TypeError as fault:
            return Outcome(
                call.id, Status.ERROR, {}, "bad_arguments", f"{service.name}: {fault}", Executed.NO
            )
        before = time.process_time()
        try:
            result = function(context, **call.arguments)
        except (
            BaseException
        ) as fault:  # a service may raise SystemExit or its like: that must not end the node
            if from_outside(fault):
                raise
            return Outcome(
                call.id,
                Status.ERROR,
                {},
                "hung" if isinstance(fault, Hung) else "exception",
                describe(fault),
            )
        try:
            result = checked_result(call.id, result, "values")
        except ValueError as fault:
            return Outcome(
                call.id, Status.ERROR, {}, "bad_result", f"what it returned cannot be sent: {fault}"
            )
        cpu = time.process_time() - before
        return Outcome(
            call.id, result.status, result.values, result.cause, result.text, cpu_seconds=cpu
        )

    return answer
