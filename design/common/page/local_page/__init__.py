"""Pages for the browsers of this machine, told of what happens as it happens."""
