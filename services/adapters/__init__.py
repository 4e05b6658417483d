"""Adapters for other vendors' robots and programs: one folder each, written with petrobot's public
API only."""
