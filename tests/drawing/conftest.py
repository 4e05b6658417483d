"""Random nets with the structure of robot tasks: steps, alternatives, loops, parallel branches."""

from __future__ import annotations

import numpy as np

from petrobot.coordinator.task.net import Net


class _Growing:
    """A net that is built block by block."""

    def __init__(self, random: np.random.Generator) -> None:
        self.random = random
        self.places = {"runs": 3, "arm": 1, "go": 0}
        self.transitions: dict[str, tuple[dict[str, int], dict[str, int]]] = {
            "start": ({"runs": 1, "arm": 1}, {"go": 1})
        }

    def place(self) -> str:
        """Add a place."""
        name = f"place_{len(self.places)}"
        self.places[name] = 0
        return name

    def step(self, takes: list[str], gives: list[str]) -> None:
        """Add a transition."""
        self.transitions[f"step_{len(self.transitions)}"] = (
            dict.fromkeys(takes, 1),
            dict.fromkeys(gives, 1),
        )

    def block(self, start: str, depth: int) -> str:
        """Add a block that begins at a place; return the place where it ends."""
        kind = (
            self.random.choice(
                ["sequence", "sequence", "action", "parallel", "alternative", "loop"]
            )
            if depth
            else "action"
        )
        if kind == "action":
            end = self.place()
            self.step([start], [end])
            return end
        if kind == "sequence":
            return self.block(self.block(start, depth - 1), depth - 1)
        if kind == "parallel":
            left, right = self.place(), self.place()
            self.step([start], [left, right])
            ends = [self.block(left, depth - 1), self.block(right, depth - 1)]
            end = self.place()
            self.step(ends, [end])
            return end
        end = self.block(start, depth - 1)
        if kind == "loop":
            self.step([end], [start])
        else:
            self.step([self.block(start, depth - 1)], [end])
        return end


def random_task(random: np.random.Generator, depth: int) -> Net:
    """Return a random net of about 10 (depth 2) to 60 (depth 4) nodes."""
    net = _Growing(random)
    net.step([net.block("go", depth)], ["arm"])
    return Net.build(net.places, net.transitions)
