"""Every promised figure in full: measured by `make proof`, written to docs/figures.md."""
