"""The colours all pictures share: a family is known by its colour on every page."""

HORIZONTAL, VERTICAL = "#0b6e99", "#d9730d"
ALARM, INK, FAINT, PAPER = "#c4161c", "#37352f", "#d3d1cb", "#f7f6f3"
