"""Universal Robots e-Series arms over RTDE, without anything installed beside petrobot."""
