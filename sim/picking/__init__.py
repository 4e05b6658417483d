"""The laboratory of the pick-and-place task: table, parts, trays, camera and arm in software."""
