"""The course of a fibre: its curve as points, arcs and cubics, and how sharply it bends."""
