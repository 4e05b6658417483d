"""Mutual TLS: certificates, their expiry, and the listening socket."""
