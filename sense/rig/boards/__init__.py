"""Boards that read the fibres: drivers, wire formats and firmware."""
