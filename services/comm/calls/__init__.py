"""Calls and results between a caller and a node: machines, and their asyncio shells."""
