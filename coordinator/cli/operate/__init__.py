"""The operator's commands: each steers the mission run that goes on, in the protocol that the page
speaks too."""
