"""The motion node's actions: the PUMA 560, its drives and its ways of intercepting."""
