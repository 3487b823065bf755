"""A plugin of LeRobot: an arm of two joints that go where they are sent, and a leader that moves them evenly."""

from .devices import VirtualArm as VirtualArm
from .devices import VirtualLeader as VirtualLeader
