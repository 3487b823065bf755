"""The colours all pictures share: a family is known by its colour on every page."""

HORIZONTAL, VERTICAL = "#0b6e99", "#d9730d"
ALARM, INK, FAINT, PAPER = "#c4161c", "#37352f", "#d3d1cb", "#f7f6f3"
CURVES = (INK, VERTICAL, HORIZONTAL, ALARM, "#3f8f5b", "#8a63b0", "#b58900", "#7d7a75")
"""For the curves of a figure, in their order."""
