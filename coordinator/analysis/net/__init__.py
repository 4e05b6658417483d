"""What a net can do: state space, structure, and the verdicts on them; pure."""
