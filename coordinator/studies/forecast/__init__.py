"""Forecasts from measured runs: what further runs of a task will come to, said before they run and
compared afterwards.

The method (docs/forecast.md): runs of the training throws give laws for each action in the contexts
that a chi-square test tells apart; the task's net composes them, throw by throw, by simulation; a
bootstrap over training throws gives predictive intervals.
"""
