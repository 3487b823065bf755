"""Readings: filters, and presses found in them."""
