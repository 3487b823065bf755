"""Boards that read the fibres: one folder for each kind."""
