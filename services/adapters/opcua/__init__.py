"""OPC UA: a PLC or machine as a device, through the library asyncua (LGPL, an optional extra)."""
