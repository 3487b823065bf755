"""The localizer: from presses to places."""
