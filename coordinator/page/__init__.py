"""The operator's page: draw a task, follow its tokens, step in; one server in the coordinator's own
loop."""
