"""What tests of live work share."""

from padforge.sense import Recording


def first_presses(recording: Recording, presses: int) -> Recording:
    """Its first presses, by their places alone."""
    end = int(recording.begun[presses])
    edges = (getattr(recording, name)[:presses] for name in ("presses_mm", "begun", "lifted"))
    return Recording(recording.readings[:end], recording.times_s[:end], *edges)
