"""CAN and CANopen: the simulated bus, frames, a master, and the drives' profile CiA 402."""
