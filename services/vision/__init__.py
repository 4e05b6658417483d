"""The vision node's actions: calibrate, locate, track and predict."""
