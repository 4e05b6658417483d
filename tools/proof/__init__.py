"""Every figure that the documentation promises, measured in full: `make proof` writes
docs/figures.md."""
