"""The laboratory of the mobile robot: track, rover, sensors and camera."""
