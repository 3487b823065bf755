"""Touches as they happen."""
