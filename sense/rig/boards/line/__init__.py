"""Any board that sends its samples as lines of text."""
