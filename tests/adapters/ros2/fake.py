"""A rosbridge server that behaves like the source of rosbridge_suite (capabilities of ROS 2), with
action servers that misbehave by name; it runs in a separate process.

    python fake.py       prints its port; `GET /log`: all that was received, `POST /send`: a text
                         for all clients, `POST /drop`: breaks connections, `POST /reset`: as new
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Callable
from typing import Any

Message = dict[str, Any]
REQUIRED: dict[str, dict[str, type]] = {
    "send_action_goal": {"action": str, "action_type": str},
    "cancel_action_goal": {"action": str},
    "advertise_action": {"action": str, "type": str},
    "unadvertise_action": {"action": str},
    "action_feedback": {"action": str},
    "action_result": {"action": str, "status": int, "result": bool},
    "call_service": {"service": str},
    "advertise": {"topic": str, "type": str},
    "publish": {"topic": str},
    "subscribe": {"topic": str},
}
"""Required fields of each operation (`basic_type_check` of rosbridge); an operation without them is
dropped with a line in the server's own log."""
PERIOD = 0.05  # s between two feedback messages
DONE = {"error_code": {"val": 1}, "text": "done"}


class Fake:
    """Goals, services and topics for one client at a time; `now` is any clock (s).

    The name of an action server decides what it does: /ok, /aborts, /rejects, /absent, /silent,
    /slow (until cancelled), /stubborn (does not obey a cancel), /races (has succeeded when a cancel
    comes), /late (rosbridge does not know the goal for 0.3 s, so ignores its cancel), /nan, /nested
    (as the first servers answered), /wide (a result too large), /other (feedback of another type).
    """

    def __init__(self) -> None:
        self.log: list[Message] = []
        self.goals: dict[str, tuple[Message, float, float]] = {}
        """Goal, when it began, when it last sent feedback."""

    def receive(self, now: float, message: Message) -> list[Message]:
        """Return what the server answers at once."""
        self.log.append(message)
        wanted = REQUIRED.get(message.get("op", ""), {"never": str})
        if any(not isinstance(message.get(name), kind) for name, kind in wanted.items()):
            return []
        op, name = message["op"], message.get("action", "")
        if op == "send_action_goal":
            if name in ("/rejects", "/absent", "/rest"):  # /rest: while no client offers it
                words = (
                    "Action goal was rejected"
                    if name == "/rejects"
                    else "No action server available"
                )
                return [self.result(message, 0, words, good=False)]
            self.goals[message.get("id", "")] = (message, now, now)
        elif op == "cancel_action_goal" and message.get("id") in self.goals:
            goal, begun, _ = self.goals[message["id"]]
            if name == "/races":
                return [self.end(goal, 4, DONE)]
            if name not in ("/silent", "/stubborn") and (name != "/late" or now - begun > 0.3):
                return [self.end(goal, 5, {})]
        elif op == "call_service" and message["service"] != "/silent":
            good = message["service"] != "/fails"
            values: Any = {"sum": sum(message["args"].values())} if good else "it failed"
            if message["service"] == "/speeds":
                told = [m["msg"] for m in self.log if m["op"] == "publish"]
                values = {"speeds": [m["linear"]["x"] for m in told]}
            answer = {"op": "service_response", "service": message["service"], "id": message["id"]}
            return [{**answer, "values": values, "result": good}]
        elif op == "subscribe" and message["topic"] == "/latched":
            return [{"op": "publish", "topic": "/latched", "msg": {"data": True}}]
        return []

    def step(self, now: float) -> list[Message]:
        """Return the messages of the action servers that are due."""
        said = []
        for identity, (goal, begun, told) in list(self.goals.items()):
            name, age = goal["action"], now - begun
            ends = ("/ok", "/aborts", "/nan", "/nested", "/wide", "/other")
            if name in ends and age > 4 * PERIOD:
                said.append(self.ended(goal, name))
            elif name != "/silent" and now - told >= PERIOD:
                self.goals[identity] = (goal, begun, now)
                left: Message = {"distance": max(0.0, 1.0 - age), "state": "moving"}
                if name == "/other":  # that of control_msgs/action/FollowJointTrajectory
                    left = {"joint_names": ["a"], "distance": {"positions": [age]}}
                reply = {"op": "action_feedback", "action": name, "id": identity}
                said.append({**reply, "values": left})
        return said

    def ended(self, goal: Message, name: str) -> Message:
        """Return the result of an action server by its name."""
        if name == "/nan":
            return self.end(goal, 4, {"error_code": {"val": 1}, "time": None})
        if name == "/wide":
            return self.end(goal, 4, {"deep": [[[list(range(9000))]] * 3]})
        if name == "/nested":
            values = {"status": 4, "result": DONE}
            del self.goals[goal["id"]]
            said = {"op": "action_result", "action": name, "id": goal["id"]}
            return {**said, "values": values, "result": True}
        return self.end(goal, 6 if name == "/aborts" else 4, DONE)

    def end(self, goal: Message, status: int, values: Message) -> Message:
        self.goals.pop(goal["id"], None)
        return self.result(goal, status, values)

    @staticmethod
    def result(goal: Message, status: int, values: Any, good: bool = True) -> Message:
        said = {"op": "action_result", "action": goal["action"], "id": goal["id"]}
        return {**said, "values": values, "status": status, "result": good}


class Server:
    """Fakes behind WebSockets. A goal for an advertised action goes to the client that offers it,
    under an id of the server's own, as rosbridge does it."""

    def __init__(self) -> None:
        self.fake = Fake()
        self.clients: dict[Any, None] = {}
        self.offers: dict[str, Any] = {}
        self.routed: dict[str, tuple[Any, str]] = {}
        self.count = 0

    async def client(self, request: Any) -> Any:
        from aiohttp import web

        socket = web.WebSocketResponse()
        await socket.prepare(request)
        self.clients[socket] = None
        async for frame in socket:
            try:
                message = json.loads(frame.data)
            except ValueError:
                continue
            await self.take(socket, message)
        del self.clients[socket]
        for name in [name for name, owner in self.offers.items() if owner is socket]:
            del self.offers[name]
        return socket

    async def take(self, socket: Any, message: Message) -> None:
        op, identity = message.get("op"), message.get("id", "")
        if op == "advertise_action":
            self.offers[message["action"]] = socket
        owner = self.offers.get(message.get("action", ""))
        if op == "send_action_goal" and owner is not None:
            self.count += 1
            inner = f"action_goal:{message['action']}:{self.count}"
            self.routed[inner] = (socket, identity)
            self.fake.log.append(message)
            await owner.send_json({**message, "id": inner})
        elif op == "cancel_action_goal" and owner is not None:
            for inner, (asker, outer) in self.routed.items():
                if outer == identity and asker is socket:
                    cancel = {"op": op, "id": inner, "action": message["action"]}
                    await owner.send_json(cancel)
        elif op in ("action_feedback", "action_result") and identity in self.routed:
            self.fake.log.append(message)
            asker, outer = self.routed[identity]
            if op == "action_result":
                del self.routed[identity]
            if not asker.closed:
                await asker.send_json({**message, "id": outer})
        else:
            for said in self.fake.receive(time.monotonic(), message):
                await socket.send_str(json.dumps(said))

    async def everyone(self, text: str) -> None:
        for socket in list(self.clients):
            with contextlib.suppress(ConnectionError):
                await socket.send_str(text)

    async def step(self) -> None:
        while True:
            for said in self.fake.step(time.monotonic()):
                await self.everyone(json.dumps(said))
            await asyncio.sleep(0.01)

    async def serve(self, ready: Callable[[int], None], port: int = 0) -> None:
        """Serve on this host until the process ends."""
        from aiohttp import web

        async def log(request: Any) -> Any:
            return web.json_response(self.fake.log)

        async def send(request: Any) -> Any:
            await self.everyone(await request.text())
            return web.Response()

        async def drop(request: Any) -> Any:
            for socket in list(self.clients):
                socket._req.transport.abort()
            return web.Response()

        async def reset(request: Any) -> Any:
            self.fake, self.routed = Fake(), {}
            return web.Response()

        app = web.Application(client_max_size=16 << 20)
        app.router.add_post("/drop", drop)
        app.router.add_post("/reset", reset)
        app.add_routes(
            [web.get("/", self.client), web.get("/log", log), web.post("/send", send)],
        )
        runner = web.AppRunner(app)
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", port)
        await site.start()
        stepping = asyncio.create_task(self.step())
        ready(runner.addresses[0][1])
        await stepping


if __name__ == "__main__":
    asyncio.run(Server().serve(lambda port: print(port, flush=True)))
