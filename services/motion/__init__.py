"""Actions and drivers of the motion node: the PUMA 560, its drives, and how it intercepts a
ball."""
