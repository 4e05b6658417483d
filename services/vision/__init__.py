"""Actions and drivers of the vision node: calibrate, locate, track and predict."""
