"""Verification and forecast of a net; pure."""
