"""One catching task as a Petri net, as a behaviour tree and as a state machine: what each program's
tools find, forecast, learn and survive. docs/experiment.md has the results."""
