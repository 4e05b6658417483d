"""Streams between processes: set points and images."""
