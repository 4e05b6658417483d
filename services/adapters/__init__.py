"""Robots and programs of others: one folder each, written against petrobot's public API alone."""
