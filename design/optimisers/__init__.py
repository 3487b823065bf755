"""How fibres are found."""
