"""Calibrations on paper: charts, and their part of the report."""
