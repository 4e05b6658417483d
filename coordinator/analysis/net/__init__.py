"""Qualitative analysis of a net: state space, structure, and verdicts on both. Pure."""
