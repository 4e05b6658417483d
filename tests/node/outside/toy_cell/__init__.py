"""A package as a laboratory would write it: drivers and actions for the tests of the node."""
