"""The operator's page: draw a task, follow its tokens, intervene; one server in the coordinator's
event loop."""
