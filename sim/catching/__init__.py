"""The laboratory of the catching cell: ball, table, arm and camera."""
