"""The net that is executed: its states, its progress, and what keeps it from its end."""
