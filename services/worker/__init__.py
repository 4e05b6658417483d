"""Processes of a node that run the code of users: actions and cyclic drivers."""
