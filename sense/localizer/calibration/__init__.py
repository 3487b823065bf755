"""How a localizer is learnt, renewed and judged."""
