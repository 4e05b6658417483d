"""Analysis of the executed net: its states, its verdicts of progress, and the causes of dead
ends."""
