"""What is kept of a run, and read, derived and exported again."""
