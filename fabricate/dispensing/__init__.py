"""Fibres laid by a machine: the ways of its needle as G-code, URScript and a picture, and whether it can go them."""
