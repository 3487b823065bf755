"""The design on paper: the plan, and its part of the report."""
