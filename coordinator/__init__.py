"""The coordinator: runs the task's net, verifies it and forecasts it."""
