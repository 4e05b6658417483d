"""All that two processes must agree on."""
