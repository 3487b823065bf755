"""Outlines drawn finely, and the true curves and cells that come of them."""
