"""Forecasts from measured runs: predict what further trials of a task will yield, before they run,
and compare afterwards.

The method (docs/forecast.md): the training trials give duration distributions and outcome
probabilities of each action, in contexts that a chi-square test distinguishes. The task's net
composes them by simulation, trial by trial. A bootstrap over the training trials gives predictive
intervals.
"""
