"""Processes of a node that run user code: actions and cyclic drivers."""
