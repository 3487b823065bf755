"""Paths of the fibres: curves through their knots, bends, keep-outs, fitting and drawings."""
