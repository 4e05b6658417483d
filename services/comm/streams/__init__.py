"""Streams from node to node: set points and images."""
