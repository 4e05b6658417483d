"""Universal Robots e-Series arms over RTDE; no other package is needed."""
