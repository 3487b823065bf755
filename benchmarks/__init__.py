"""Run time against error of the package's work, beside plain ways of doing the same."""
