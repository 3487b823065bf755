"""The simulated pad and recordings of it."""
