"""Verification and forecast of Petri nets. Pure: no clock, no input or output but files."""
