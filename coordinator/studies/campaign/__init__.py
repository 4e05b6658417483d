"""Campaigns: many mission runs of a task in parallel lock-step cells, one table row for each
trial."""
