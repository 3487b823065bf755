"""The twin is the as-built model (digital twin) of a printed pad, identified from a recording of presses."""
