"""What a host runs: nodes that offer primitive actions and services."""
