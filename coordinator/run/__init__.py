"""One mission run: the engine meets the network, in real time and in lock step."""
