"""The pad: fibres as curves, and what they signal for a press."""
