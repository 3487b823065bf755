"""The command line of sense."""
