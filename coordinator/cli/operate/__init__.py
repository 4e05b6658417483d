"""The operator's commands: each steers the active mission run, by the same protocol as the page."""
