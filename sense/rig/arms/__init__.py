"""Arms that press: one folder for each kind."""
