"""The twin of a printed pad: how it was laid, wired and turned, and what a press really does to it."""
