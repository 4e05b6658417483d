"""A simulated filling station with an OPC UA server, in place of a PLC: `python plc.py`.

It fills a bottle for one second when `start` becomes true, and then says `filled` until `start`
becomes false. Every five seconds a bottle passes its light barrier `bottle`.
"""

import asyncio

from asyncua import Server, ua


async def main() -> None:
    """Serve until Ctrl-C."""
    server = Server()
    await server.init()
    server.set_endpoint("opc.tcp://127.0.0.1:4840")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    space = await server.register_namespace("urn:station")
    nodes = {}
    for name in ("start", "filled", "bottle"):
        identifier = ua.NodeId(f"Station.{name}", space)
        nodes[name] = await server.nodes.objects.add_variable(identifier, name, False)
        await nodes[name].set_writable()
    async with server:
        print("ready", flush=True)
        asked = ticks = 0
        while True:
            await asyncio.sleep(0.1)
            asked = asked + 1 if await nodes["start"].get_value() else 0
            await nodes["filled"].write_value(asked > 10)
            ticks += 1
            await nodes["bottle"].write_value(ticks % 50 < 10)


if __name__ == "__main__":
    asyncio.run(main())
