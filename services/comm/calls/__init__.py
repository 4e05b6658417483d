"""Calls from a caller to a node: sans-I/O machines for both ends, and their asyncio shells.

`caller.py` and `callee.py` are the machines, each with its tables of calls; `peers.py` holds the
callers of a node and their rights, `events.py` the events of both ends.
`link.py` is one asyncio connection, `client.py` and `server.py` build on it.
"""
