"""petrobot: a robot task is one Petri net, run over several computers.

What users import is here: what an action uses and returns, the drivers' contract, and the clock of
a test. Everything in `petrobot.coordinator`, `petrobot.services` and `petrobot.sim` is private, and
may change without notice.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import TYPE_CHECKING, Any

if sys.platform != "linux":
    raise ImportError("petrobot needs Linux, also in WSL 2, a container or a virtual machine")

# Before numpy is loaded. The threads of OpenBLAS wait for each other in busy loops: where a robot's
# processes share the cores, inverting a matrix of 128 rows takes a hundred times as long with them.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

if TYPE_CHECKING:
    from petrobot.coordinator.operator.client import OperatorClient, OperatorError
    from petrobot.services.action import (
        CallFailed,
        Cancelled,
        CommandRefused,
        Context,
        Result,
        Status,
        error,
        failure,
        provisional,
        success,
    )
    from petrobot.services.camera import CameraDriver
    from petrobot.services.comm.streams.image import Image
    from petrobot.services.comm.streams.line import ByteLine, Link
    from petrobot.services.conformance import DriverCheck, check_driver
    from petrobot.services.device import Driver, Ports, Remote, Setpoint, key, numbers, table
    from petrobot.services.joint_chain import JointChain
    from petrobot.services.joint_motion import Axis, JointMotion
    from petrobot.services.perform import perform
    from petrobot.services.rehearsal import Rehearsal, rehearse, rehearse_task
    from petrobot.services.session_thread import SessionThread, SimulatedSession

__all__ = [
    "Axis",
    "ByteLine",
    "CallFailed",
    "CameraDriver",
    "Cancelled",
    "CommandRefused",
    "Context",
    "Driver",
    "DriverCheck",
    "Image",
    "JointChain",
    "JointMotion",
    "Link",
    "OperatorClient",
    "OperatorError",
    "Ports",
    "Rehearsal",
    "Remote",
    "Result",
    "SessionThread",
    "Setpoint",
    "SimulatedSession",
    "Status",
    "check_driver",
    "error",
    "failure",
    "key",
    "numbers",
    "perform",
    "provisional",
    "rehearse",
    "rehearse_task",
    "success",
    "table",
]

_HOMES = {
    **dict.fromkeys(("ByteLine", "Link"), "petrobot.services.comm.streams.line"),
    **dict.fromkeys(
        ("Driver", "Ports", "Remote", "Setpoint", "key", "numbers", "table"),
        "petrobot.services.device",
    ),
    "CameraDriver": "petrobot.services.camera",
    "Image": "petrobot.services.comm.streams.image",
    "JointChain": "petrobot.services.joint_chain",
    **dict.fromkeys(("Axis", "JointMotion"), "petrobot.services.joint_motion"),
    **dict.fromkeys(("DriverCheck", "check_driver"), "petrobot.services.conformance"),
    **dict.fromkeys(("OperatorClient", "OperatorError"), "petrobot.coordinator.operator.client"),
    "perform": "petrobot.services.perform",
    **dict.fromkeys(("SessionThread", "SimulatedSession"), "petrobot.services.session_thread"),
    **dict.fromkeys(("Rehearsal", "rehearse", "rehearse_task"), "petrobot.services.rehearsal"),
}


def __getattr__(name: str) -> Any:
    # Loaded when first used: a command that runs no action starts without any of it.
    if name not in __all__:
        raise AttributeError(f"petrobot has no {name!r}; it has {', '.join(__all__)}")
    return getattr(importlib.import_module(_HOMES.get(name, "petrobot.services.action")), name)


def __dir__() -> list[str]:
    return __all__
