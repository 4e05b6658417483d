"""CAN and CANopen: the simulated bus, frames, a master, and the drive profile CiA 402."""
