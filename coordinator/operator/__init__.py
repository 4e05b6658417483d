"""The operator's hand and eye: live missions, simulated runs, and how they are started and
steered."""
