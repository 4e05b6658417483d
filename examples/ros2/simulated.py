"""A robot that drives to poses, as rosbridge shows it: in simulated time inside the driver, or as a
server of its own (`python simulated.py 9090`)."""

import asyncio
import json
import math
import sys
import time

SPEED, PERIOD = 0.5, 0.1  # m/s; s between two feedback messages


class Robot:
    """Answers the messages of one rosbridge client; times are seconds of any clock."""

    def __init__(self):
        self.x = self.y = 0.0
        self.goal = None
        self.last = self.told = self.pressed = 0.0

    def receive(self, now, message):
        """Return what rosbridge sends at once after a message."""
        if message["op"] == "send_action_goal":
            refused = self.goal is not None or "pose" not in message["args"]
            if refused:
                text = "Action goal was rejected"
                return [{**self.name(message), "values": text, "status": 0, "result": False}]
            self.goal, self.last, self.told = message, now, now - PERIOD
        elif message["op"] == "cancel_action_goal" and self.goal is not None:
            if self.goal["id"] == message["id"]:
                return [self.end(5)]
        elif message["op"] == "call_service":
            answer = {"values": {"success": True, "message": "charged"}, "result": True}
            service = {"service": message["service"], "id": message.get("id")}
            return [{"op": "service_response", **service, **answer}]
        return []

    def step(self, now):
        """Return what rosbridge sends because time has passed."""
        if self.goal is None:
            if now - self.pressed <= 1.0:
                return []
            self.pressed = now  # someone waits, and presses again
            button = {"op": "publish", "topic": "/button"}
            return [{**button, "msg": {"data": down}} for down in (True, False)]
        pose = self.goal["args"]["pose"]["pose"]["position"]
        left = math.hypot(pose["x"] - self.x, pose["y"] - self.y)
        share = min(1.0, SPEED * (now - self.last) / left) if left > 0 else 1.0
        self.x, self.y = (
            self.x + share * (pose["x"] - self.x),
            self.y + share * (pose["y"] - self.y),
        )
        self.last = now
        if share == 1.0:
            return [self.end(4)]
        if now - self.told < PERIOD:
            return []
        self.told = now
        feedback = {"distance_remaining": (1 - share) * left}
        return [{**self.name(self.goal, "action_feedback"), "values": feedback}]

    def end(self, status):
        """The result of the goal; 4 is succeeded, 5 cancelled."""
        goal, self.goal = self.goal, None
        return {**self.name(goal), "values": {}, "status": status, "result": True}

    def name(self, goal, op="action_result"):
        return {"op": op, "action": goal["action"], "id": goal.get("id")}


async def serve(port):
    """Serve robots, one for each client, on this host."""
    from aiohttp import web

    async def client(request):
        socket, robot = web.WebSocketResponse(), Robot()
        await socket.prepare(request)
        begun = time.monotonic()

        async def tell(messages):
            for message in messages:
                await socket.send_str(json.dumps(message))

        async def step():
            while not socket.closed:
                await tell(robot.step(time.monotonic() - begun))
                await asyncio.sleep(0.02)

        stepping = asyncio.create_task(step())
        async for frame in socket:
            await tell(robot.receive(time.monotonic() - begun, json.loads(frame.data)))
        stepping.cancel()
        return socket

    app = web.Application()
    app.router.add_get("/", client)
    runner = web.AppRunner(app)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", port).start()
    print("serving", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve(int(sys.argv[1])))
