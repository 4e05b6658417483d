"""Who holds the controls of a mission: one operator acts, the others watch and can ask. It outlives
mission runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from petrobot.coordinator.operator.feed import Feed

FREE = frozenset({"estop", "take_controls", "ask_controls", "release_controls"})
"""What everybody may say, whoever holds the controls."""

Answer = dict[str, Any]


class Controls:
    """The holder and those who ask; every change is told on the feed."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self.holder: str | None = None
        self._asking: list[str] = []

    def plain(self) -> dict[str, Any]:
        """As in a snapshot."""
        return {"holder": self.holder, "asking": list(self._asking)}

    def fault(self, who: str, verb: str) -> Answer | None:
        """Why somebody may not give a command; None if he may."""
        if verb in FREE or self.holder == who:
            return None
        return refusal(
            "not_holder",
            f"{self.holder or 'nobody'} holds the controls; take or ask for them first",
        )

    def take(self, who: str) -> Answer:
        """Take them when nobody has them."""
        if self.holder not in (None, who):
            return refusal("held", f"{self.holder} holds the controls; ask for them")
        return self._hand_over(who)

    def ask(self, who: str) -> Answer:
        """Tell whoever holds them that somebody would like to."""
        if who != self.holder and who not in self._asking:
            self._asking.append(who)
        return self._hand_over(self.holder)

    def release(self, who: str, to: object = None) -> Answer:
        """Free them, or hand them to one who asks; from anybody else it does nothing."""
        if who != self.holder:
            return {"ok": True}
        return self._hand_over(to if isinstance(to, str) and to in self._asking else None)

    def carry_out(self, who: str, verb: str, data: Mapping[str, Any]) -> Answer | None:
        """Answer the commands that are about the controls; None for every other."""
        if verb == "take_controls":
            return self.take(who)
        if verb == "ask_controls":
            return self.ask(who)
        return self.release(who, data.get("to")) if verb == "release_controls" else None

    def _hand_over(self, holder: str | None) -> Answer:
        self.holder = holder
        self._asking = [name for name in self._asking if name != holder]
        self._feed.emit("controls", controls=self.plain())
        return {"ok": True}


def refusal(code: str, text: str) -> Answer:
    """The answer to a command that is not carried out."""
    return {"ok": False, "code": code, "text": text}
