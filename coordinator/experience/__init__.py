"""What runs have taught: the file it is kept in, the selector that learns from it, and what it
means for a task."""
