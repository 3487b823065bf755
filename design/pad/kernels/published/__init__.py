"""The published way to see a pad: sampled fibres, and the information in their signals."""
