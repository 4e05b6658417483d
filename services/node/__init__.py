"""A node: the server process of one host, which offers actions and services."""
