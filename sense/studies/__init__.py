"""Studies: the paper's simulations for any pads, carried further; each a table, a figure and what it shows."""
