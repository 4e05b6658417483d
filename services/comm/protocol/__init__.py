"""The node protocol as bytes: messages, their coding, order and protection; no socket."""
