"""Lock step: parties that advance together, tick by tick, in one process or in several."""
