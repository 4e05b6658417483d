"""Simulated CANopen devices."""
