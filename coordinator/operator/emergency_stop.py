"""The emergency stop: sent directly to the nodes that own devices, and to their bus if a node does
not answer.

It needs no coordinator, and no coordinator can delay it: each node receives it over a separate
connection, stops its devices at once (a drive's quick stop is sent with the next bus cycle) and
lets no action use them until `CLEAR`. If a node that owns a CAN bus of this host does not answer in
time, or the driver of one of its devices does not, all CANopen devices of that bus are stopped by
NMT (CiA 301: a drive that leaves OPERATIONAL while it moves stops, object 6007h)."""

from __future__ import annotations

import asyncio
import os
import secrets
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from msgspec import Struct, field

from petrobot.coordinator.run.supervisor import is_local
from petrobot.services.comm.calls.caller import Caller, Notice, Patience, PeerLost
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.calls.link import in_thread
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.protocol.messages import (
    COORDINATOR,
    EMERGENCY_STOP,
    Answer,
    Command,
    Hello,
)
from petrobot.services.comm.protocol.security import KeyFileError
from petrobot.services.comm.protocol.wire import NEWEST_VERSION, OLDEST_VERSION
from petrobot.services.comm.tls.credentials import Credentials, credentials
from petrobot.services.host.emergency_latch import ALL, FOLDER, STATE, Cleared, LatchError, latch_of

STOP = EMERGENCY_STOP
CLEAR = "clear_emergency"
_SILENT = "no answer"
_DONE = {STOP: ("stopped",), CLEAR: ("cleared", "not ready", _SILENT)}
"""By order: the answers of a device that has carried it out. One that is not ready or does not
answer is not known to stand still; but its node has cleared the stop before it answers, so it
continues or starts without one."""
NODE_LATE = 0.15
"""Wait for a node's answer before its bus is stopped instead (s)."""
STORED = 10.0
"""Wait for a connected node's answer (s). It has stopped its devices by then, but answers once that
is on its disk, and some disks need seconds."""
STANDSTILL = 1.5
"""Time for devices to come to rest before their last answer is reported as it is (s)."""
ASK_AGAIN = 0.02
BUS_PATIENCE = 0.5
BUS_TIMES, BUS_PAUSE = 3, 0.01
"""How often the order is sent on the bus, and the pause between (s): one frame may be lost."""


class Stopped(Struct):
    """Result of the stop for one node's devices."""

    node: str
    devices: dict[str, str] = field(default_factory=dict)
    """Each device's answer: stopped, stopping, cleared, not ready, no answer."""
    open: list[str] = field(default_factory=list)
    """Devices that are not known to have carried out the order: their drivers are frozen, are being
    started again, or still move them."""
    seconds: float | None = None
    """Time from the order to the first answer (s); None without an answer."""
    why: str = ""
    """Why there is no answer."""
    bus: str = ""
    """What was done on the bus instead of the node."""
    note: str = ""
    """Further report of the node: that the stop is not stored, or not cleared, on its disk."""
    latch: str = ""
    """What was stored or cleared on disk instead of the node."""
    cleared: bool = False
    """Whether the stop of a node that does not answer was cleared on its disk."""

    @property
    def answered(self) -> bool:
        """Whether the node itself has answered."""
        return self.seconds is not None

    @property
    def done(self) -> bool:
        """Whether every device of the node is known to have carried out the order, and a stop is
        stored."""
        return self.cleared or (self.answered and not self.open and not self.note)


def nodes_with_devices(directory: Directory) -> list[str]:
    """Return the nodes that own devices with a driver: those that receive an emergency stop."""
    return list(
        dict.fromkeys(device.node for device in directory.devices.values() if device.driver)
    )


def buses_of(directory: Directory, node: str) -> list[Mapping[str, Any]]:
    """Return the CAN buses of a node's devices, in the form that
    `services.comm.canopen.ports.open_can` accepts."""
    found = []
    for device in directory.devices.values():
        can = device.config.get("can") or {
            k: device.config[k] for k in _CAN_KEYS if k in device.config
        }
        if device.node == node and {"interface", "channel"} <= can.keys() and can not in found:
            found.append(can)
    return found


_CAN_KEYS = ("interface", "channel", "bitrate")


class EmergencyLine:
    """A connection to one node only for emergency stops. The node accepts it with any
    services.toml: a stop must not fail because of a hash."""

    def __init__(self, directory: Directory, node: str, proves: Credentials) -> None:
        """Raises KeyFileError."""
        name = f"estop-{secrets.token_hex(4)}"
        entry = directory.nodes[node]
        caller = Caller(
            node,
            Hello(OLDEST_VERSION, NEWEST_VERSION, "client", name, name),
            patience=Patience(answer=STORED),
            auto_ack=True,
        )
        self.node = node
        self.why = ""
        self.note = ""
        self.reached = False
        self._name = name
        self._numbers = 0
        self._device_names = frozenset(directory.devices)
        self._answers: dict[str, asyncio.Future[Mapping[str, Any]]] = {}
        self.client = Client(
            entry.host,
            entry.port,
            caller,
            on_notices=self._hear,
            key=proves.key,
            tls=proves.client(),
        )

    async def connect(self, timeout: float) -> bool:
        """Connect within this time (s); return whether the node accepted, otherwise `why` has the
        reason."""
        self.client.start()
        up = self.reached = await self.client.connected(timeout)
        if not up and not self.why:
            said = self.client.trouble if self.client.answered else ""
            trouble = f": {said}" if said else ""
            self.why = (
                f"{self.node} does not answer on {self.client.host}:{self.client.port}{trouble}"
            )
        return up

    async def order(self, verb: str, timeout: float) -> dict[str, str] | None:
        """Give an order; return each device's answer, or None without an answer in time."""
        self._numbers += 1
        identity = f"{self._name}/{verb}#{self._numbers}"
        told = self._answers[identity] = asyncio.get_running_loop().create_future()
        self.client.caller.command(self.client.now(), Command(identity, verb))
        self.client.flush()
        try:
            async with asyncio.timeout(timeout):
                data = await told
        except TimeoutError:
            self.why = self.why or f"no answer within {timeout:g} s"
            return None
        finally:
            self._answers.pop(identity, None)
        self.note = str(data.get("note") or "")
        answers = data.get("answers")
        if isinstance(answers, Mapping):
            return {str(device): str(answer) for device, answer in answers.items()}
        self.why = str(data.get("text") or data.get("cause") or "an empty answer")
        return None

    def devices_of(self, answers: Mapping[str, str]) -> dict[str, str]:
        """Return the answers of devices. The one under the node's own name is of its actions
        without a device, unless a device has that name."""
        own = {self.node} - self._device_names
        return {device: answer for device, answer in answers.items() if device not in own}

    async def close(self) -> None:
        """Close the connection."""
        await self.client.close()

    def _hear(self, _: float, notices: list[Notice]) -> None:
        for notice in notices:
            if isinstance(notice, Answer):
                told = self._answers.get(notice.id)
                if told is not None and not told.done():
                    told.set_result(notice.data)
            elif isinstance(notice, PeerLost):
                self.why = notice.reason


async def order_all(
    directory: Directory, verb: str = STOP, *, bus: bool = False, begun: Directory | None = None
) -> list[Stopped]:
    """Give an order to every node that owns devices, all at once; with `bus`, stop their buses
    without waiting for the nodes.

    `begun`: what services.toml was when the nodes were started, if it was edited since. A node that
    is only there, at another address or without devices now, is stopped too, and cleared if it is
    still stopped."""
    orders = {_place(directory, node): directory for node in nodes_with_devices(directory)}
    if begun is not None:
        then = still_stopped(begun) if verb == CLEAR else nodes_with_devices(begun)
        orders = {_place(begun, node): begun for node in then} | orders
    asked = (_order(cell, node, verb, bus) for (node, *_), cell in orders.items())
    return list(await asyncio.gather(*asked))


def _place(directory: Directory, node: str) -> tuple[str, str, int]:
    entry = directory.nodes[node]
    return node, entry.host, entry.port


async def _order(directory: Directory, node: str, verb: str, bus: bool) -> Stopped:
    stopped = Stopped(node)
    line = None
    kept = await in_thread(partial(_kept, directory, node)) if verb == CLEAR else None
    try:
        line = EmergencyLine(directory, node, credentials(directory, COORDINATOR))
    except KeyFileError as fault:  # bus and latch need no key
        stopped.why = str(fault)
    asking = asyncio.create_task(_ask(line, stopped, verb))
    try:
        if verb == STOP:
            if not bus:
                await _answered(stopped, asking)
            if not bus and not stopped.answered:
                # The processes of its devices check the latch themselves: they stop even if the
                # node is frozen.
                stopped.latch = await _latch(directory, node)
            if bus or not stopped.answered:
                stopped.bus = await _stop_buses(directory, node)
        await asking
        if verb == STOP and not stopped.bus and _SILENT in stopped.devices.values():
            stopped.bus = await _stop_buses(directory, node)
        if verb == STOP and not stopped.answered:
            stopped.latch = stopped.latch or await _latch(directory, node)
        elif stopped.answered:
            stopped.latch = ""  # The node was only late, and stores the stop itself.
        if verb == CLEAR and not stopped.answered and not (line and line.reached):
            said, stopped.cleared = await _unlatch(directory, node)
            stopped.latch = f"{stopped.why or 'it does not answer'}; {said}" if said else ""
        elif stopped.done and kept and kept == await in_thread(partial(_kept, directory, node)):
            # The node has not cleared this latch: it runs with another copy of services.toml.
            said, cleared = await _unlatch(directory, node)
            stopped.note = "" if cleared else said
    finally:
        if line is not None:
            await line.close()
    return stopped


async def _answered(stopped: Stopped, asking: asyncio.Task[None]) -> None:
    """Wait for the node's first answer, at most `NODE_LATE` s."""
    deadline = asyncio.get_running_loop().time() + NODE_LATE
    while (
        not stopped.answered and not asking.done() and asyncio.get_running_loop().time() < deadline
    ):
        await asyncio.wait({asking}, timeout=ASK_AGAIN)


async def _ask(line: EmergencyLine | None, stopped: Stopped, verb: str) -> None:
    """Repeat the order until all devices stand still; `seconds` is the time of the first answer."""
    if line is None:
        return
    loop = asyncio.get_running_loop()
    begun = loop.time()
    if await line.connect(STANDSTILL):
        while True:
            answers = await line.order(verb, STORED)
            if answers is None:
                break
            if stopped.seconds is None:
                stopped.seconds = loop.time() - begun
                begun = loop.time()  # its devices may have stopped while it wrote
            stopped.devices, stopped.note = line.devices_of(answers), line.note or stopped.note
            stopped.open = [d for d, said in stopped.devices.items() if said not in _DONE[verb]]
            if "stopping" not in stopped.devices.values() or loop.time() - begun > STANDSTILL:
                return
            await asyncio.sleep(ASK_AGAIN)
    stopped.why = line.why


async def _latch(directory: Directory, node: str) -> str:
    """Store on disk that the devices of a silent node are stopped; the node obeys when it continues
    or is started."""
    if elsewhere := await _elsewhere(directory, node):
        return f"not latched: {elsewhere}; run `petrobot estop` there before it is started again"
    try:
        # By name, too: services.toml may give a device to another node before this one is cleared.
        stopped = [ALL, *_devices_of(directory, node)]
        path = await in_thread(partial(latch_of(directory.source, node).stop, stopped))
    except LatchError as fault:
        return f"not latched: {fault}; do not start {node} again before the cell is safe"
    # The last folder is of this user: a node that another user runs does not look there.
    shared = os.environ.get(STATE) or path.parent.name == FOLDER
    whose = directory.source if shared else f"{directory.source} as this user"
    return (
        f"latched: a {node} that runs with {whose} keeps its devices stopped, by "
        f"{path}, until `petrobot estop --clear`"
    )


async def _elsewhere(directory: Directory, node: str) -> str:
    """Return why a node is not known to be on this host; empty if it is here."""
    host = directory.nodes[node].host
    try:
        async with asyncio.timeout(STANDSTILL):
            here = await in_thread(partial(is_local, host))
    except TimeoutError:
        return f"the lookup of {host} takes too long"
    return "" if here else f"{node} is on another host"


async def _unlatch(directory: Directory, node: str) -> tuple[str, bool]:
    """Clear the stop of a node that does not answer on its disk; return what was done, and whether
    the stop is cleared."""
    if node not in await in_thread(partial(still_stopped, directory)):
        return "", False
    devices = _devices_of(directory, node)
    try:
        await in_thread(partial(latch_of(directory.source, node).clear, devices, devices))
    except LatchError as fault:
        return f"not cleared: {fault}", False
    return "its stop is cleared on disk, so its devices accept orders once it runs", True


def _kept(directory: Directory, node: str) -> Cleared | None:
    """Return which clearing the latch of a node of this host saw last; None if it stops nothing."""
    stopped = node in still_stopped(directory)
    return latch_of(directory.source, node).cleared if stopped else None


def _devices_of(directory: Directory, node: str) -> list[str]:
    return [name for name, device in directory.devices.items() if device.node == node]


def still_stopped(directory: Directory) -> list[str]:
    """Return the nodes of this host whose devices are still stopped according to their disks."""
    nodes = nodes_with_devices(directory)
    stopped = [node for node in nodes if latch_of(directory.source, node).stopped()]
    return [node for node in stopped if is_local(directory.nodes[node].host)]


async def _stop_buses(directory: Directory, node: str) -> str:
    """Stop every CANopen device on the node's buses by NMT; return what was done."""
    buses = buses_of(directory, node)
    if not buses:
        return ""
    if elsewhere := await _elsewhere(directory, node):
        return (
            f"its bus is not stopped: {elsewhere}; run `petrobot estop --bus` there, or press the "
            "hardware's emergency stop"
        )
    return "; ".join([await in_thread(partial(_stop_bus, can)) for can in buses])


def _stop_bus(can: Mapping[str, Any]) -> str:
    from petrobot.services.comm.canopen.cia301 import NmtCommand, nmt
    from petrobot.services.comm.canopen.ports import open_can

    patience = {"timeout": BUS_PATIENCE} if can["interface"] == "petrobot_stream" else {}
    try:
        port = open_can({**can, **patience})
        try:
            for _ in range(BUS_TIMES):
                port.send(nmt(NmtCommand.STOP))
                time.sleep(BUS_PAUSE)
                # If a socket is closed with unread bytes, the other end may lose what we have sent.
                port.receive()
        finally:
            port.close()
    except (ConnectionError, ValueError, OSError) as fault:
        return f"bus {can['channel']}: {fault}"
    return f"bus {can['channel']}: all devices stopped by NMT"
