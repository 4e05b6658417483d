"""Studies of many runs: campaigns, forecasts from measured runs, and reports."""
