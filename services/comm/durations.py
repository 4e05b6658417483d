"""Durations on a command line, for `argparse`: what is no number of seconds is refused in words."""

from __future__ import annotations

import argparse
import math


def positive(text: str) -> float:
    """Seconds, more than 0."""
    value = not_negative(text)
    if value == 0.0:
        raise argparse.ArgumentTypeError(f"{text}: give seconds, more than 0")
    return value


def not_negative(text: str) -> float:
    """Seconds, 0 or more."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: give seconds, a number not below 0")
    return value
