"""Driver of an OPC UA server: class `OpcUaSession`, one client session in its own thread.

Its command is `{"write": {NAME: value, ...}}`. Its state has `values` by name, `up`, `faults`, the
number of writes requested (`asked`) and finished (`done`), and `write_fault`: why the last one
failed.
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import time
from collections.abc import Mapping
from typing import Any, Final
from urllib.parse import urlsplit

from petrobot import Driver, Ports, SessionThread, key, table

LOOK: Final = 0.3
"""Time between two checks of the connection (s)."""
HEARTBEAT: Final = "i=2258"
"""The server's clock, a node that each server has. It changes all the time, so its notifications
show that the server still serves the subscription."""
BEAT: Final = 500.0
"""Time between two of these (ms)."""
KEPT: Final = 30_000
"""How long the server keeps the session of a driver that was killed (ms): a small PLC has few."""
LARGEST: Final = 40_000
"""Characters of all values together, which are published each cycle."""
CHANGED: Final = "nodes of the server have changed"
UNKNOWN: Final = "the session was lost: it is unknown whether it was written"


class OpcUaSession(Driver):
    """One OPC UA server: named nodes, and events from their values."""

    period = 0.02
    obeys = ("dry_run",)
    url: str = key(text="as opc.tcp://192.168.0.10:4840")
    nodes: dict[str, str] = key(text='names, as { start = "ns=2;s=Cell.Start" }')
    events: dict[str, Any] = key({}, 'as { part = { node = "sensor", becomes = true } }')
    on_stop: dict[str, Any] = key({}, "what is written when it is stopped, as { start = false }")
    interval: float = key(0.05, "s between two notifications of the server", above=0)
    patience: float = key(4.0, "s for an answer of the server", above=0)
    certificate: str = key("", "file (.der or .pem); with it the session is encrypted")
    private_key: str = key("", "file of its key (.der or .pem)")
    server_certificate: str = key("", "file of the server's certificate: only it is trusted")
    application_uri: str = key("", "without it that of the certificate")
    user: str = key("", "name of the user, if the server asks for one")
    password_file: str = key("", "file with the user's password")
    insecure: bool = key(False, "allow a session without security beyond this host")

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        """Start connecting. Raises ValueError for wrong keys, OSError for a missing file,
        ImportError without asyncua."""
        super().__init__(config, ports)
        self._check_keys()
        try:
            import asyncua  # noqa: F401 - late: it takes long, and is an extra
        except ImportError as fault:
            raise ImportError('OPC UA needs asyncua: pip install "petrobot[opcua]"') from fault
        # Its warnings repeat, at each attempt, what `faults` says once.
        logging.getLogger("asyncua").setLevel(logging.ERROR)
        # It logs each lost connection as a crash; this driver reports the loss itself.
        logging.getLogger("asyncua.client").setLevel(logging.CRITICAL)
        self._keys: dict[str, tuple[Any, bytes, str]] = {}
        """By key: what the file holds, its content, "der" or "pem"."""
        self._password = ports.file(self.password_file).decode().strip("\r\n") if self.user else ""
        if self.user and not self._password:
            raise ValueError(f"password_file: {self.password_file} is empty")
        if self.certificate:
            self._read_keys()
        self.values: dict[str, Any] = {}
        self.faults = {"session": "no session yet"}
        self._asked = self._done = 0
        self._write_fault = ""
        self._stop_due, self._stop_number = False, 0
        """Whether `on_stop` is not written yet, and the number of its write."""
        self._session = SessionThread(self._serve)

    def _check_keys(self) -> None:
        if "@" in self.url:  # messages quote the address: this one must not
            raise ValueError("url: expected no login in it; write user and password_file")
        if bool(self.user) != bool(self.password_file):
            raise ValueError("user: write user and password_file, or neither")
        host = urlsplit(self.url).hostname
        if not self.url.startswith("opc.tcp://") or not host:
            raise ValueError(f"url: expected opc.tcp://HOST:PORT, found {self.url!r}")
        loopback = host == "localhost"
        with contextlib.suppress(ValueError):
            loopback = loopback or ipaddress.ip_address(host).is_loopback
        if not loopback and not self.certificate and not self.insecure:
            raise ValueError(
                f"url: {host} is another host, and the session would have no security: write"
                " certificate, private_key and server_certificate, or insecure = true"
            )
        if self.certificate and not (self.private_key and self.server_certificate):
            raise ValueError("certificate: write private_key and server_certificate, too")
        for name, event in self.events.items():
            table(event, f"events.{name}", ("node", "becomes"))
        for name in (*self.on_stop, *(event["node"] for event in self.events.values())):
            if name not in self.nodes:
                raise ValueError(f"no node {name!r}; there are {', '.join(self.nodes)}")

    def _read_keys(self) -> None:
        """Read the certificates and the key. Raises ValueError if they do not fit together."""
        from cryptography import x509
        from cryptography.hazmat.primitives import serialization

        for name in ("certificate", "private_key", "server_certificate"):
            path, secret = getattr(self, name), name == "private_key"
            data = self.ports.file(path)
            form = "pem" if b"-----BEGIN" in data else "der"
            place, kind = (serialization, "private_key") if secret else (x509, "x509_certificate")
            load = getattr(place, f"load_{form}_{kind}")
            try:
                loaded = load(data, None) if secret else load(data)
            except TypeError:
                raise ValueError(f"{name}: {path} has a password: no node can type one") from None
            except ValueError:
                expected = f"expected a {name.split('_')[-1]} (.der or .pem)"
                raise ValueError(f"{name}: {expected}, {path} is something else") from None
            self._keys[name] = loaded, data, form
        mine = self._keys["certificate"][0]
        if self._keys["private_key"][0].public_key() != mine.public_key():
            raise ValueError(f"private_key: {self.private_key} is not that of {self.certificate}")
        try:
            names = mine.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
            uris = names.get_values_for_type(x509.UniformResourceIdentifier)
        except x509.ExtensionNotFound:
            uris = []
        self.application_uri = self.application_uri or next(iter(uris), "")
        if uris and self.application_uri not in uris:
            raise ValueError(
                f"application_uri: expected that of {self.certificate} ({', '.join(uris)}), found "
                f"{self.application_uri!r}: servers compare them"
            )

    # --- driver ---------------------------------------------------------------------------------

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Write nodes. Raises ValueError without a session or for an unknown name."""
        writes = body.get("write")
        if set(body) != {"write"} or not isinstance(writes, Mapping) or not writes:
            raise ValueError(f'expected {{"write": {{NAME: value}}}}, found {dict(body)!r:.80}')
        for name in writes:
            if name not in self.nodes:
                raise ValueError(f"no node {name!r}; there are {', '.join(self.nodes)}")
        if "session" in self.faults:
            raise ValueError(f"{self.url}: {self.faults['session']}")
        self._write(dict(writes))

    def _write(self, values: dict[str, Any]) -> None:
        self._asked += 1
        if self.dry_run:  # its machine would answer: here nothing changes
            self._done, self._write_fault = self._asked, ""
        else:
            self._session.send(values)

    def step(self, now: float) -> None:
        """Take over what the session's thread has received; raise events for changed values."""
        for kind, item in self._session.news():
            if kind == "up":  # values and faults of nodes may have come before it
                self.faults = {**self.faults, **item}
                self.faults.pop("session", None)
                if self._stop_due:
                    self.stop(now)
            elif kind == "down":
                self.faults, self.values = {"session": f"{item}; trying again"}, {}
                if self._done < self._asked:
                    self._done, self._write_fault = self._asked, UNKNOWN
            elif kind == "done":
                self._done, self._write_fault = self._done + 1, item
                self._stop_due = self._stop_due and self._done != self._stop_number
            elif kind == "bad":
                name, text = item
                self.faults[name] = f"{self.nodes[name]}: {text}"
                self.values.pop(name, None)
            else:
                name, value = item
                self.faults.pop(name, None)
                known, before = name in self.values, self.values.get(name)
                self.values[name] = value
                # The first value of a session is not a change: the value before it is unknown.
                for event, said in self.events.items() if known and before != value else ():
                    if said["node"] == name and value == said["becomes"]:
                        self.ports.raise_event(event, value=value)

    def state(self) -> Mapping[str, Any]:
        """Return plain data; see the docstring of this module."""
        up = "session" not in self.faults
        return {
            "up": up,
            "values": dict(self.values) if up else {},  # what is read can be written, too
            "faults": dict(self.faults),
            "asked": self._asked,
            "done": self._done,
            "write_fault": self._write_fault,
        }

    def stop(self, now: float) -> None:
        """Write `on_stop`; without a session, or if it ends before, in the next one."""
        self._stop_due = bool(self.on_stop)
        if self._stop_due and "session" not in self.faults:
            self._write(dict(self.on_stop))
            self._stop_number = self._asked

    def stopped(self) -> bool:
        """Whether there is a session, the server has all that was written, and it reports the
        values of `on_stop`."""
        rest = self.dry_run or all(
            self.values.get(name) == value for name, value in self.on_stop.items()
        )
        return rest and self._done == self._asked and "session" not in self.faults

    def close(self) -> None:
        self._session.close(self.patience)

    # --- the session's thread -------------------------------------------------------------------

    async def _serve(self, session: SessionThread) -> None:
        """One session."""
        from asyncua import Client

        client = Client(self.url, timeout=self.patience)
        client.application_uri = self.application_uri or "urn:petrobot"
        client.session_timeout = KEPT
        if self.user:
            client.set_user(self.user)
            client.set_password(self._password)
        try:
            await self._connect(client)
            try:
                await self._serve_session(client, session)
            except (TimeoutError, ConnectionError):
                _abort(client)  # a frozen server would not answer the goodbye either
                raise
            finally:
                await client.disconnect()
        finally:
            _abort(client)

    async def _connect(self, client: Any) -> None:
        from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
        from asyncua.crypto.uacrypto import CertProperties

        try:
            if self._keys:
                own, secret, server = (CertProperties(*file[1:]) for file in self._keys.values())
                await client.set_security(
                    SecurityPolicyBasic256Sha256, own, secret, server_certificate=server
                )
            await client.connect()
        except Exception as fault:
            if why := await self._refusal(fault):
                raise ConnectionError(why) from fault
            raise

    async def _refusal(self, fault: Exception) -> str:
        """Return why the server gives no session, and by which key; empty if it is just away."""
        from asyncua import Client
        from asyncua.crypto import security_policies as policies
        from cryptography.hazmat.primitives.serialization import Encoding

        code = type(fault).__name__
        if code.startswith(("BadIdentityToken", "BadUserAccessDenied")):
            login = f"user {self.user!r} with the password in {self.password_file}"
            no_login = "anybody without a name: write user and password_file"
            return f"user: the server does not accept {login if self.user else no_login}"
        if self._keys and code == "BadCertificateTimeInvalid":
            own = self._keys["certificate"][0]
            span = f"{own.not_valid_before_utc:%Y-%m-%d} to {own.not_valid_after_utc:%Y-%m-%d}"
            return f"certificate: {self.certificate} is valid from {span}: renew it ({fault})"
        if self._keys and code.startswith("BadCertificate"):
            return f"certificate: the server does not accept {self.certificate}: {fault}"
        try:
            offers = await Client(
                self.url, timeout=self.patience
            ).connect_and_get_server_endpoints()
        except Exception:
            return ""
        kind = "Basic256Sha256" if self._keys else "None"
        policy, mode = getattr(policies, f"SecurityPolicy{kind}").URI, 3 if self._keys else 1
        fitting = [e for e in offers if (e.SecurityPolicyUri, e.SecurityMode) == (policy, mode)]
        if not fitting:
            have = {
                f"{e.SecurityPolicyUri.split('#')[-1]} {e.SecurityMode.name.strip('_')}"
                for e in offers
            }
            keys = "Basic256Sha256 SignAndEncrypt" if self._keys else "None: write a certificate"
            return f"certificate: the server offers only {', '.join(sorted(have))}, and not {keys}"
        if self._keys:
            pinned = self._keys["server_certificate"][0].public_bytes(Encoding.DER)
            if all(bytes(e.ServerCertificate or b"")[: len(pinned)] != pinned for e in fitting):
                return f"server_certificate: {self.server_certificate} is not that of this server"
        return ""

    async def _serve_session(self, client: Any, session: SessionThread) -> None:
        """Subscribe to the nodes; write what is sent until the session shall end."""
        from asyncua import ua

        nodes: dict[str, tuple[Any, Any]] = {}
        faults: dict[str, str] = {}
        sock = client.uaclient.protocol.transport.get_extra_info("socket")
        heard = _Notifications(session, LARGEST // max(1, len(self.nodes)))
        subscription = await client.create_subscription(1000 * self.interval, heard)
        heartbeat = client.get_node(HEARTBEAT)
        await subscription.subscribe_data_change(heartbeat, sampling_interval=BEAT)
        for name, text in self.nodes.items():
            try:
                node = await _node(client, text)
                nodes[name] = node, await _kind(node)
                heard.names.setdefault(node.nodeid, []).append(name)
                await subscription.subscribe_data_change(node)
            except (ua.UaError, ValueError) as fault:
                faults[name] = f"{text}: {fault}"
        session.opened(faults, sock)
        while True:
            try:
                values = await session.get(LOOK)
            except TimeoutError:
                values = {}
            if values is None:
                return
            if values:
                wrong = await _written(values, nodes, faults)
                session.tell("done", wrong)
                if wrong.endswith(CHANGED):
                    raise ConnectionError(CHANGED)  # so that types are read and values sent again
            await client.check_connection()
            if heard.lost(self.patience + BEAT / 1000):
                raise ConnectionError("the server no longer serves the subscription")


async def _node(client: Any, text: str) -> Any:
    """Return a node. The index of a namespace may change when the server restarts; its name,
    `nsu=NAME`, does not. Raises ValueError for an unknown one."""
    space, _, identifier = text.partition(";")
    if space.startswith("nsu="):
        text = f"ns={await client.get_namespace_index(space[4:])};{identifier}"
    return client.get_node(text)


async def _kind(node: Any) -> Any:
    """Return the type of a node's values; for one that is abstract, such as Number, or unknown,
    that of the present value. None if there is none, as while a PLC starts. Raises UaError if there
    is no such node."""
    from asyncua import ua

    await node.read_attribute(ua.AttributeIds.DataType)
    with contextlib.suppress(ua.UaError):
        kind = await node.read_data_type_as_variant_type()
        if kind is not ua.VariantType.Variant:
            return kind
    found = (await node.read_data_value(raise_on_bad_status=False)).Value
    return None if found is None or found.Value is None else found.VariantType


def _abort(client: Any) -> None:
    """Close the client's socket. asyncua leaves it open when it is cancelled, or when it already
    takes itself for disconnected."""
    if (protocol := client.uaclient.protocol) and protocol.transport:
        protocol.transport.abort()


class _Notifications:
    """What asyncua calls in the session's thread."""

    def __init__(self, session: SessionThread, largest: int) -> None:
        """`largest`: characters of the largest value that is kept."""
        self.names: dict[Any, list[str]] = {}
        self._largest = largest
        self._session, self._beat, self._ended = session, time.monotonic(), False

    def lost(self, patience: float) -> bool:
        """Return whether the server no longer serves the subscription: it has ended it, or nothing
        has come for so long (s)."""
        return self._ended or time.monotonic() - self._beat > patience

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        """Take a new value."""
        self._beat = time.monotonic()
        status = data.monitored_item.Value.StatusCode
        plain, fault = _plain(value), ""
        if status is not None and status.is_bad():
            fault = status.name
        elif value is None:
            fault = "it has no value"
        elif len(str(plain)) > self._largest:
            fault = f"it is longer than {self._largest} characters"
        elif _is_nan(plain):
            fault = "it is not a number (NaN)"
        for name in self.names.get(node.nodeid, ()):  # none: the heartbeat
            item = ("bad", (name, fault)) if fault else ("value", (name, plain))
            self._session.tell(*item)

    def status_change_notification(self, _: Any) -> None:
        """Note that the server has ended the subscription, as it does after a long silence."""
        self._ended = True


async def _written(
    values: Mapping[str, Any],
    nodes: Mapping[str, tuple[Any, Any]],
    faults: Mapping[str, str],
) -> str:
    """Write nodes, but none if one of the values does not fit; return what is wrong."""
    from asyncua import ua
    from asyncua.ua.ua_binary import variant_to_binary

    wanted = {}
    for name, value in values.items():
        if name not in nodes:
            return f"{name}: {faults[name]}"
        node, kind = nodes[name]
        kind = kind or await _kind(node)
        if kind is None:
            return f"{name}: its type is unknown, since it has no value yet"
        items = value if isinstance(value, list) else [value]
        try:
            # As a Boolean, any text would be encoded as True.
            if kind is ua.VariantType.Boolean and any(item not in (False, True) for item in items):
                raise ValueError(value)
            wanted[name] = node, ua.Variant(value, kind)
            variant_to_binary(wanted[name][1])  # one that cannot be encoded would end the session
        except Exception:
            text = f"{name}: expected {kind.name}, found {value!r:.40}"
            return text + await _changed(node, kind)
    for name, (node, variant) in wanted.items():
        try:
            await node.write_value(variant)
        except ua.UaStatusCodeError as fault:
            return f"{name}: {fault}" + await _changed(node, wanted[name][1].VariantType)
    return ""


async def _changed(node: Any, kind: Any) -> str:
    """Return in words that a node is not of the type that it had when the session began."""
    from asyncua import ua

    try:
        same = await _kind(node) == kind
    except ua.UaStatusCodeError:  # it is gone
        same = False
    return "" if same else f"; {CHANGED}"


def _is_nan(value: Any) -> bool:
    """Whether a value is, or contains, NaN: nothing that compares it would notice."""
    return any(map(_is_nan, value)) if isinstance(value, list) else bool(value != value)


def _plain(value: Any) -> Any:
    """Return a value as a driver's state may have it: dates, identifiers and structures as text.
    In text that the server has not sent as UTF-8, other bytes become question marks."""
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, bool | int | float | bytes):
        return value
    return str(value).encode(errors="replace").decode()
