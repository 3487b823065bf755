"""Drawings, pictures, laying page and report of a mould."""
