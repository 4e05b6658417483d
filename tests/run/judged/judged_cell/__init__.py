"""The judged cell's own package, as a laboratory would have one."""
