"""Detection of faulty fibres from readings alone."""
