"""The controls of a mission: one operator holds them, the others watch and may ask for them. They
outlive mission runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from petrobot.coordinator.operator.feed import Feed
from petrobot.coordinator.operator.port import FREE

Answer = dict[str, Any]


class Controls:
    """The holder and the clients that ask; every change is published on the feed."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self.holder: str | None = None
        self._asking: list[str] = []

    def plain(self) -> dict[str, Any]:
        """Return the state as in a snapshot."""
        return {"holder": self.holder, "asking": list(self._asking)}

    def fault(self, who: str, verb: str) -> Answer | None:
        """Return why a client may not give a command; None if it may."""
        if verb in FREE or self.holder == who:
            return None
        return refusal(
            "not_holder",
            f"{self.holder or 'no operator'} holds the controls; take or ask for them first",
        )

    def take(self, who: str) -> Answer:
        """Take the controls if they are free."""
        if self.holder not in (None, who):
            return refusal("held", f"{self.holder} holds the controls; ask for them")
        return self._hand_over(who)

    def ask(self, who: str) -> Answer:
        """Notify the holder that another client asks for the controls."""
        if who != self.holder and who not in self._asking:
            self._asking.append(who)
        return self._hand_over(self.holder)

    def release(self, who: str, to: object) -> Answer:
        """Free the controls, or hand them to a client that asks; ignored from a client without
        them."""
        if who != self.holder:
            return {"ok": True}
        return self._hand_over(to if isinstance(to, str) and to in self._asking else None)

    def carry_out(self, who: str, verb: str, data: Mapping[str, Any]) -> Answer | None:
        """Answer commands about the controls; return None for every other command."""
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
    """Return the answer to a command that is not carried out."""
    return {"ok": False, "code": code, "text": text}
