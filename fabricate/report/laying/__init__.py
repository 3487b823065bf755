"""The page for the bench: what to print, mix, cast and lay."""
