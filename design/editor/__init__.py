"""The editor of paths in a browser."""
