"""Which fibres are at fault, told from readings alone."""
