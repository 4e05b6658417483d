"""Live missions and simulated runs for operators: how they are started, shown and controlled."""
