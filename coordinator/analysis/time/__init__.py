"""How long and how likely: the stochastic view, its Markov chain, and simulation; pure."""
