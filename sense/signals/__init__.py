"""Filters and press detection: from voltages to presses."""
