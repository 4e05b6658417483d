"""Studies of many runs: campaigns, forecasts made from them, and reports."""
