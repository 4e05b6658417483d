"""What a process needs of its own computer: files, parent processes, command line, compiled
loops."""
