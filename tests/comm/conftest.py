"""Hypothesis strategies and fixtures shared by the tests of the node protocol."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterable
from typing import Any, get_args

import pytest
from hypothesis import strategies as st

from petrobot.services.comm.calls.link import LinkLimits
from petrobot.services.comm.protocol.codec import LIMITS
from petrobot.services.comm.protocol.messages import Executed, Hello, Message, Tick, Welcome
from petrobot.services.comm.protocol.wire import Connection, Side
from tests.comm.ends import Node
from tests.waiting import Limit

KEY = bytes(range(32))
SERVER = "vision"
NONCES = {Side.CLIENT: b"c" * 32, Side.SERVER: b"s" * 32}

_durations = st.floats(0.0, 1e9)
_plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False)
    | st.text(max_size=10)
    | st.binary(max_size=10),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=8,
)
_FIELDS: dict[str, st.SearchStrategy[Any]] = {
    "str": st.text(max_size=20),
    "bytes": st.binary(max_size=40),
    "bool": st.booleans(),
    "int": st.integers(0, 2**63 - 1),
    "float": _durations,
    "float | None": st.none() | _durations,
    "Executed": st.sampled_from(Executed),
    "Mapping[str, Any]": st.dictionaries(st.text(max_size=5), _plain, max_size=3),
    "tuple[str, ...]": st.lists(st.text(max_size=20), max_size=4).map(tuple),
    "tuple[float, ...]": st.lists(st.floats(-1e9, 1e9), max_size=9).map(tuple),
    "tuple[Any, ...]": st.just(()),
}


def messages_of(kinds: Iterable[type[Any]]) -> st.SearchStrategy[Any]:
    """Return a strategy for any message of these kinds."""
    return st.one_of(
        [
            st.builds(
                cls, **{name: _FIELDS[cls.__annotations__[name]] for name in cls.__struct_fields__}
            )
            for cls in kinds
        ]
    )


KINDS: list[type[Any]] = list(get_args(Message))


@pytest.fixture(scope="session")
def messages() -> st.SearchStrategy[Any]:
    """Return a strategy for messages of every kind (ticks without envelopes), within size
    limits."""
    return messages_of(cls for cls in KINDS if LIMITS[cls.KIND] >= 2048 or cls is Tick)


@pytest.fixture(scope="session")
def plain_data() -> st.SearchStrategy[Any]:
    """Return a strategy for any plain data."""
    return _plain


def new_pair(key: bytes | None) -> tuple[Connection, Connection]:
    client, server = (
        Connection(side, SERVER, key=key, nonce=NONCES[side] if key else b"")
        for side in (Side.CLIENT, Side.SERVER)
    )
    return client, server


def greet(client: Connection, server: Connection) -> bytes:
    """Shake hands between both connections; return all bytes that the client sent."""
    said = client.send(Hello(2, 2, "coordinator", "coord", "b0", 1))
    hello = server.receive_data(said)
    limit = Limit("the client's hello", steps=10)
    while not hello and limit.left():
        assert client.receive_data(server.data_to_send()) == []
        proof = client.data_to_send()
        said += proof
        hello = server.receive_data(proof)
    assert [type(message) for message in hello] == [Hello]
    client.receive_data(server.send(Welcome(2, "vision", "b1")))
    return said


@pytest.fixture
def pair() -> Callable[[bytes | None], tuple[Connection, Connection]]:
    """Return a function that makes a client and a server connection before the handshake, with
    a key or without one."""
    return new_pair


@pytest.fixture
def open_pair() -> Callable[[bytes | None], tuple[Connection, Connection]]:
    """Return a function that makes a client and a server connection after the handshake."""

    def make(key: bytes | None) -> tuple[Connection, Connection]:
        client, server = new_pair(key)
        greet(client, server)
        return client, server

    return make


@pytest.fixture
def shake_hands() -> Callable[[Connection, Connection], bytes]:
    """Return the function that shakes hands between two connections."""
    return greet


@pytest.fixture(params=[None, KEY], ids=["plain", "sealed"])
def key(request: pytest.FixtureRequest) -> bytes | None:
    """No key, then a key."""
    found: bytes | None = request.param
    return found


@pytest.fixture
async def node(key: bytes | None) -> AsyncIterator[Node]:
    """A node, with a key and without."""
    one = Node(key=key)
    await one.server.start("127.0.0.1", 0)
    yield one
    await one.server.close()


@pytest.fixture
async def open_node() -> AsyncIterator[Node]:
    """A node without a key."""
    one = Node(
        limits=LinkLimits(connections=8, opening=4, buffer_high=1 << 16, buffer_hard=1 << 20)
    )
    await one.server.start("127.0.0.1", 0)
    yield one
    await one.server.close()
