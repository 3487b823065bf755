"""Plumbing that every room stands on: files, errors, settings, pages, pictures and the command line; no science."""
