"""One mission run: connects the engine to the nodes, in real time and in lock step."""
