"""Forecasts from measured runs: what further runs of a task will come to, said before they run and
compared afterwards.

The method (docs/forecast.md): runs of the training trials give laws for each action in the contexts
that a chi-square test tells apart; the task's net composes them, trial by trial, by simulation; a
bootstrap over training trials gives predictive intervals.
"""
