"""What is minimised, and what is forbidden."""
