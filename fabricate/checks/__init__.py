"""What could go wrong in print, told before plastic is spent."""
