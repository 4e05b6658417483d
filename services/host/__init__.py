"""What any process needs of its own computer: files, parents, command line, compiled loops."""
