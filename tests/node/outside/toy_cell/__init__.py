"""A laboratory's own package, outside of petrobot: drivers and actions for the tests of the
node."""
