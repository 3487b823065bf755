"""The mould on paper: drawings, laying guide, pictures, and its part of the report."""
