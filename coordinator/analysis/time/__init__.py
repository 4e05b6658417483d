"""Quantitative analysis: the stochastic view of a task, its Markov chain, simulation. Pure."""
