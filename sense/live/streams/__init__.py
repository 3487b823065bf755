"""What is told of a pad to other programs, as it happens."""
