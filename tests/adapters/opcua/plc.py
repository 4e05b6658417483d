"""A simulated PLC for tests, in a separate process: `plc.py PORT [CERTIFICATE KEY CLIENTS
[USER PASSWORD]]`.

The node `manner` decides how `request` is acknowledged: "good", "silent", "stuck" (never
withdrawn), "blind" (it has a bad status once the request is withdrawn). Other values let something
happen once: "retyped" (`count` becomes a text node), "forgotten" (all subscriptions are deleted),
"ended" (clients are told that their subscriptions have ended), "bad" (`speed` has a bad status),
"gone" (`count` is deleted), "begun" (`early` has a value, which it has not at the start).
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Any

from asyncua import Server, ua
from asyncua.crypto.permission_rules import SimpleRoleRuleset, User, UserRole
from asyncua.crypto.truststore import TrustStore
from asyncua.crypto.validator import CertificateValidator, CertificateValidatorOptions

KINDS = {
    "request": ua.VariantType.Boolean,
    "done": ua.VariantType.Boolean,
    "sensor": ua.VariantType.Boolean,
    "count": ua.VariantType.Int16,
    "speed": ua.VariantType.Float,
    "manner": ua.VariantType.String,
    "level": ua.VariantType.Double,
}
ABSTRACT = {"level": ua.NodeId(ua.ObjectIds.Number)}
"""Data types that a node declares in place of that of its value."""


class Guard:
    """Accepts one user with one password, and nobody without a name."""

    def __init__(self, user: str, password: str) -> None:
        self.known = user, password

    def get_user(
        self,
        iserver: Any,
        username: str | None = None,
        password: str | None = None,
        certificate: Any = None,
    ) -> User | None:
        return User(role=UserRole.Admin) if (username, password) == self.known else None


async def secure(server: Server, certificate: str, key: str, clients: str, *login: str) -> None:
    """Accept only encrypted sessions of clients with these certificates, and of one user."""
    if login:
        server.iserver.set_user_manager(Guard(*login))
        server.set_identity_tokens([ua.UserNameIdentityToken])
    server.set_security_policy(
        [ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt], SimpleRoleRuleset()
    )
    await server.load_certificate(certificate)
    await server.load_private_key(key)
    trusted = TrustStore([Path(clients)], [])
    await trusted.load()
    options = CertificateValidatorOptions.TRUSTED_VALIDATION
    server.set_certificate_validator(CertificateValidator(options, trusted))


async def trouble(server: Server, nodes: dict[str, Any], manner: str) -> None:
    """Do once what a manner says."""
    if manner == "forgotten":
        service = server.iserver.subscription_service
        await service.delete_subscriptions(list(service.subscriptions))
    elif manner == "ended":
        for one in server.iserver.subscription_service.subscriptions.values():
            await one.enqueue_statuschange(ua.StatusCode(ua.StatusCodes.BadTimeout))
    elif manner == "begun":
        await nodes["early"].write_value(3, ua.VariantType.Int16)
    elif manner in ("bad", "blind"):
        name, value = ("speed", 1.5) if manner == "bad" else ("done", True)
        status = ua.StatusCode(ua.StatusCodes.BadSensorFailure)
        data = ua.DataValue(ua.Variant(value, KINDS[name]), StatusCode=status)
        await nodes[name].write_attribute(ua.AttributeIds.Value, data)
    else:
        identifier = nodes["count"].nodeid
        await server.delete_nodes([nodes["count"]])
        if manner == "retyped":
            kind = ua.VariantType.String
            node = await server.nodes.objects.add_variable(identifier, "count", "none", kind)
            await node.set_writable()


async def serve(port: str, *security: str) -> None:
    """Run until the process is killed."""
    server = Server()
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}")
    if security:
        await secure(server, *security)
    else:
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    space = await server.register_namespace("urn:test")
    nodes = {}
    for name, kind in KINDS.items():
        start = "good" if kind == ua.VariantType.String else 0
        value = bool(start) if kind == ua.VariantType.Boolean else start
        identifier = ua.NodeId(f"Cell.{name}", space)
        declared = ABSTRACT.get(name)
        node = await server.nodes.objects.add_variable(identifier, name, value, kind, declared)
        await node.set_writable()
        nodes[name] = node
    nodes["early"] = await server.nodes.objects.add_variable(
        ua.NodeId("Cell.early", space), "early", 0, ua.VariantType.Int16, ABSTRACT["level"]
    )
    await nodes["early"].set_writable()
    waits = ua.StatusCode(ua.StatusCodes.BadWaitingForInitialData)
    await nodes["early"].write_attribute(ua.AttributeIds.Value, ua.DataValue(StatusCode=waits))
    foreign = ua.NodeId("NoSuchType", space)
    await server.nodes.objects.add_variable(
        ua.NodeId("Cell.foreign", space), "foreign", 7, ua.VariantType.Int32, foreign
    )
    async with server:
        print("ready", flush=True)
        served = False
        while True:
            manner, request = await nodes["manner"].get_value(), await nodes["request"].get_value()
            if manner == "good" or (manner in ("stuck", "blind") and request):
                await nodes["done"].write_value(bool(request))
                served = bool(request)
            elif manner == "blind" and served:
                await trouble(server, nodes, manner)
            if manner in ("retyped", "gone", "forgotten", "ended", "bad", "begun"):
                await nodes["manner"].write_value("good")
                await trouble(server, nodes, manner)
            await asyncio.sleep(0.02)


asyncio.run(serve(*sys.argv[1:]))
