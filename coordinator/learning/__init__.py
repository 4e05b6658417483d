"""Estimates of actions and selectors that learn among them (docs/learning.md); pure: no clock,
files or randomness of its own."""
