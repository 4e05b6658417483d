"""TLS between the hosts of a cell: certificates, their expiry, and a listener with bounded
handshakes."""
