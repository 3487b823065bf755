"""The clock of a rig, from which drivers and the press loop take all their times: the host's monotonic one, s.

It is called as `clock.now()` and `clock.sleep(seconds)`, so that tests can replace it by another one.
"""

from time import monotonic as now
from time import sleep as sleep

__all__ = ["now", "sleep"]
