"""Experiments with petrobot that are no part of the package."""
