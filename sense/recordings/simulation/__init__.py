"""The simulated pad, and the recording that the published protocol makes of it."""
