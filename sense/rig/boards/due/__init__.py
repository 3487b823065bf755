"""The board that reads the fibres."""
