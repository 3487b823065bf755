"""The command line of design."""
