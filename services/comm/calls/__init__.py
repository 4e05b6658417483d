"""Calls from a caller to a node: sans-I/O machines for both ends, and their asyncio shells.

`caller.py` and `callee.py` are the machines; `pending.py` holds the caller's tables of calls,
`runs.py` and `peers.py` the node's tables of runs and callers, `events.py` the events of both ends.
`link.py` is one asyncio connection, `client.py` and `server.py` build on it.
"""
