"""Estimates of actions, and selectors that learn which action to choose (docs/learning.md)."""
