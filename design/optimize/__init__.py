"""Search for a pad: gradient and genetic, from many starts, resumable."""
