"""Run time against error of filters and localizers, beside plain ways of doing the same."""
