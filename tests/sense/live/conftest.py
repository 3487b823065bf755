"""What tests of live work share."""

from padforge.sense import Recording


def first_presses(recording: Recording, presses: int) -> Recording:
    """Its first presses, by their places alone."""
    end = int(recording.down_command[presses])
    edges = (getattr(recording, name)[:presses] for name in ("presses_mm", "down_command", "up_command"))
    return Recording(recording.readings[:end], recording.times_s[:end], *edges)
