"""Studies: the simulations of the paper for any pads, and further ones; each makes a table, a figure and a text."""
