"""Toolpaths of a machine that places the fibres, as G-code and URScript."""
