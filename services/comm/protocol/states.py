"""Who may say what when: the states of a connection of the node protocol, as tables."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum

from petrobot.services.comm.protocol.messages import (
    Accept,
    Answer,
    Bye,
    Call,
    Cancel,
    Challenge,
    Command,
    Event,
    EventAck,
    Feedback,
    Hello,
    Outcome,
    Ping,
    Pong,
    Proof,
    Refuse,
    ResultAck,
    SetPoint,
    StreamOpen,
    Subscribe,
    Tick,
    Welcome,
    Withdraw,
)


class Side(Enum):
    """Which end of the connection this is."""

    CLIENT = "client"
    SERVER = "server"


class State(Enum):
    """Where a connection stands."""

    OPENING = "opening"
    OPEN = "open"
    CLOSING = "closing"
    CLOSED = "closed"


class Phase(Enum):
    """State in full: what the next message may be."""

    HELLO = "hello"
    """Nothing was said yet."""
    HELLO_SENT = "hello sent"
    CHALLENGED = "challenged"
    """Server: proof awaited."""
    PROVED = "proved"
    """Client: proof sent."""
    DECIDING = "deciding"
    """Server: its owner answers WELCOME or REFUSE."""
    OPEN = "open"
    CLOSING = "closing"
    CLOSED = "closed"


STATES: Mapping[Phase, State] = {
    Phase.OPEN: State.OPEN,
    Phase.CLOSING: State.CLOSING,
    Phase.CLOSED: State.CLOSED,
}

_BOTH = frozenset(cls.KIND for cls in (Ping, Pong, Tick, Bye, Refuse))
_FROM_CLIENT = _BOTH | {
    cls.KIND
    for cls in (
        Call,
        ResultAck,
        Cancel,
        EventAck,
        Subscribe,
        Command,
        StreamOpen,
        SetPoint,
        Withdraw,
    )
}
_FROM_SERVER = _BOTH | {cls.KIND for cls in (Accept, Feedback, Outcome, Event, Answer)}
NOTHING: frozenset[int] = frozenset()
_REFUSE = frozenset((Refuse.KIND,))

MAY_COME: Mapping[tuple[Side, Phase], frozenset[int]] = {
    (Side.SERVER, Phase.HELLO): frozenset((Hello.KIND,)),
    (Side.SERVER, Phase.CHALLENGED): _REFUSE | {Proof.KIND},
    (Side.SERVER, Phase.OPEN): _FROM_CLIENT,
    (Side.CLIENT, Phase.HELLO_SENT): _REFUSE | {Challenge.KIND, Welcome.KIND},
    (Side.CLIENT, Phase.PROVED): _REFUSE | {Welcome.KIND},
    (Side.CLIENT, Phase.OPEN): _FROM_SERVER,
}
MAY_GO: Mapping[tuple[Side, Phase], frozenset[int]] = {
    (Side.CLIENT, Phase.HELLO): frozenset((Hello.KIND,)),
    (Side.CLIENT, Phase.HELLO_SENT): _REFUSE,
    (Side.CLIENT, Phase.PROVED): _REFUSE,
    (Side.CLIENT, Phase.OPEN): _FROM_CLIENT,
    (Side.SERVER, Phase.HELLO): _REFUSE,
    (Side.SERVER, Phase.CHALLENGED): _REFUSE,
    (Side.SERVER, Phase.DECIDING): _REFUSE | {Welcome.KIND},
    (Side.SERVER, Phase.OPEN): _FROM_SERVER,
}
LAST = frozenset((Bye.KIND, Refuse.KIND))
OVER = (Phase.CLOSING, Phase.CLOSED)
