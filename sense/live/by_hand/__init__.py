"""Recording by hand: a person is shown where to press, and the press is found in the readings."""
