"""Runs roslibpy, an independent client, in a separate process: sends goals, prints the messages
received.

python foreign.py PORT ACTION GOAL_JSON [CANCEL_AFTER_FEEDBACK]
"""

from __future__ import annotations

import json
import sys
import threading

import roslibpy


def main(port: int, action: str, goal: str, cancel: bool) -> None:
    ros = roslibpy.Ros("127.0.0.1", port, transport="asyncio")
    ros.run(60)
    client = roslibpy.ActionClient(ros, action, "petrobot_interfaces/action/RunTask")
    begun, over = threading.Event(), threading.Event()

    def feedback(told: roslibpy.Feedback) -> None:
        print(json.dumps({"feedback": dict(told)}), flush=True)
        begun.set()

    def ended(kind: str, told: roslibpy.Result) -> None:
        print(json.dumps({kind: told["values"], "status": told["status"].value}), flush=True)
        over.set()

    goals = roslibpy.Goal(json.loads(goal))
    identity = client.send_goal(
        goals, lambda r: ended("result", r), feedback, lambda r: ended("error", r)
    )
    if cancel and begun.wait(60):
        client.cancel_goal(identity)
    if not over.wait(60):
        print(json.dumps({"timeout": True}), flush=True)
    ros.terminate()


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], sys.argv[3], len(sys.argv) > 4)
