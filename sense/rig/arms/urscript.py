"""Motion of a UR arm by a URScript program of ours, where ur-rtde cannot be installed.

The program is sent to the controller once. Commands reach it through RTDE input registers of the range that the
controller reserves for RTDE clients, and it answers through output registers of that range (PolyScope 3.9, 5.3, or
later). A command counts only if its number is the last one plus one; the first number is drawn at random, so that
nothing that an earlier program was sent, or that is repeated, counts as a command. A heartbeat comes with every
package: once it is silent the program stops the arm, lifts the tool off the pad if it was told how, and ends.
"""

import math
import secrets
import socket
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from padforge.sense.rig.arms import rtde
from padforge.sense.rig.arms.rtde import RtdeLink

FIRST_REGISTER = 24  # the lower ones are reserved for fieldbuses
PROGRESS_REGISTER = FIRST_REGISTER
MOVE, STOP, END = 1, 2, 3  # kinds of commands
DONE, UNDER_WAY, REFUSED = 0, 1, 2  # outcomes of a command; the register of progress holds 4 * number + outcome
KICK_S = 0.04  # between two heartbeats
SILENCE_S = 0.25  # of the heartbeat, after which the program stops the arm
ANSWER_S = 0.4  # wait for the program's answer to a command
START_S = 1.0  # wait for the program's start
STOP_M_S2 = 5.0
RETREAT_M_S2 = 0.5
MAX_NUMBER = 1 << 28  # so that 4 * number stays well within 32 bits
INT_INPUTS = [f"input_int_register_{FIRST_REGISTER + i}" for i in range(3)]  # number, kind, heartbeat
DOUBLE_INPUTS = [f"input_double_register_{FIRST_REGISTER + i}" for i in range(8)]  # pose, speed, acceleration
TCP_OUTPUTS = [f"output_double_register_{FIRST_REGISTER + i}" for i in range(6)]

PROGRAM = """\
def padforge():
  global number = {number}
  global moving = False
  global handle = 0
  global target = p[0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
  global speed = 0.0
  global acceleration = 0.0

  thread move_to_target():
    movel(target, a=acceleration, v=speed)
    write_output_integer_register(24, 4 * number + {DONE})
    moving = False
  end

  def stop_moving():
    if moving:
      kill handle
      moving = False
    end
    stopl({STOP_M_S2})
  end

  tcp = get_tcp_offset()
  write_output_float_register(24, tcp[0])
  write_output_float_register(25, tcp[1])
  write_output_float_register(26, tcp[2])
  write_output_float_register(27, tcp[3])
  write_output_float_register(28, tcp[4])
  write_output_float_register(29, tcp[5])
  heartbeat = read_input_integer_register(26)
  silent_cycles = 0
  moved = False
  ending = False
  write_output_integer_register(24, 4 * number + {DONE})
  while silent_cycles < {max_silent_cycles} and not ending:
    if read_input_integer_register(26) == heartbeat:
      silent_cycles = silent_cycles + 1
    else:
      heartbeat = read_input_integer_register(26)
      silent_cycles = 0
    end
    if read_input_integer_register(24) == number + 1:
      sync() # in the next cycle all registers of the package are certainly there
      stop_moving()
      number = number + 1
      if read_input_integer_register(25) == {MOVE}:
        x = read_input_float_register(24)
        y = read_input_float_register(25)
        z = read_input_float_register(26)
        rx = read_input_float_register(27)
        ry = read_input_float_register(28)
        rz = read_input_float_register(29)
        target = p[x, y, z, rx, ry, rz]
        speed = read_input_float_register(30)
        acceleration = read_input_float_register(31)
        if is_within_safety_limits(target):
          write_output_integer_register(24, 4 * number + {UNDER_WAY})
          moved = True
          moving = True
          handle = run move_to_target()
        else:
          write_output_integer_register(24, 4 * number + {REFUSED})
        end
      else:
        ending = (read_input_integer_register(25) == {END})
        write_output_integer_register(24, 4 * number + {DONE})
      end
    end
    sync()
  end
  stop_moving()
{retreat}end
"""
RETREAT = """\
  tip = get_actual_tcp_pose()
  if tip[2] < {height} and tip[0] > {x0} and tip[0] < {x1} and tip[1] > {y0} and tip[1] < {y1} and moved and not ending:
    movel(p[tip[0], tip[1], {height}, tip[3], tip[4], tip[5]], a={RETREAT_M_S2}, v={speed})
  end
"""


@dataclass(frozen=True)
class Retreat:
    """What the program does by itself once the heartbeat is silent: lift the tool straight up, if it stands low."""

    height_mm: float  # of the tip in the base frame, after it
    x_mm: tuple[float, float]  # outside of these the tool is not above the pad, and stays
    y_mm: tuple[float, float]
    speed_mm_s: float


def write_program(number: int, rate_hz: float, retreat: Retreat | None) -> str:
    """Return the program for a controller.

    Args:
        number: what the number of the first command follows.
        rate_hz: control cycles of the controller, a second.
        retreat: what the program does by itself; None to leave the tool where it stopped.
    """
    lift = ""
    if retreat is not None:
        lengths = (retreat.height_mm, *retreat.x_mm, *retreat.y_mm, retreat.speed_mm_s)
        height, x0, x1, y0, y1, speed = (f"{length / 1e3:.6f}" for length in lengths)  # URScript wants m
        lift = RETREAT.format(height=height, x0=x0, x1=x1, y0=y0, y1=y1, speed=speed, RETREAT_M_S2=RETREAT_M_S2)
    return PROGRAM.format(
        number=number,
        max_silent_cycles=math.ceil(SILENCE_S * rate_hz),
        retreat=lift,
        **{"MOVE": MOVE, "END": END, "DONE": DONE, "UNDER_WAY": UNDER_WAY, "REFUSED": REFUSED},
        STOP_M_S2=STOP_M_S2,
    )


class UrscriptControl:
    """The program at work; see `Control` in `rtde_worker`."""

    progress_register = PROGRESS_REGISTER

    def __init__(self, host: str, retreat: Retreat | None) -> None:
        """Send the program and wait for its start.

        OSError or ValueError if it does not start, or the controller lacks a register or lets another program write it.
        """
        self.moving = False
        self._answered = threading.Condition()
        self._progress, self._is_stopped = 0, False
        self._number, self._kind, self._heartbeat = secrets.randbelow(MAX_NUMBER), STOP, 0
        self._move: tuple[float, ...] = (0.0,) * len(DOUBLE_INPUTS)
        self._link = RtdeLink(host, START_S)
        self._link.set_inputs([*INT_INPUTS, *DOUBLE_INPUTS])
        self._link.start([f"output_int_register_{PROGRESS_REGISTER}", *TCP_OUTPUTS])
        self.kick()
        with socket.create_connection((host, rtde.SCRIPT_PORT), START_S) as script:
            script.sendall(write_program(self._number, self._link.rate_hz, retreat).encode())
            self._tcp = self._await_start()
        self._link.pause()
        self.identity: dict[str, Any] = {"driver": "URScript"}

    def tcp_offset(self) -> Sequence[float]:
        """Return the tool centre point from the flange, m and rad."""
        return self._tcp

    def update(self, progress: int, is_stopped: bool) -> None:
        """Note the newest register of progress, and whether a protective or emergency stop holds the arm."""
        with self._answered:
            self._progress, self._is_stopped = progress, is_stopped
            if is_stopped or progress == 4 * self._number + DONE:
                self.moving = False
            self._answered.notify_all()

    def kick(self) -> None:
        """Send a heartbeat."""
        self._heartbeat += 1
        self._link.write(self._number, self._kind, self._heartbeat, *self._move)

    def move(self, pose: Sequence[float], speed: float, acceleration: float) -> bool:
        """Start a straight move (m, rad, m/s, m/s²); return whether the arm accepts it."""
        self._move = (*pose, speed, acceleration)
        if not (accepted := self._command(MOVE)):
            self.moving = False
        return accepted

    def stop(self) -> None:
        """Stop the arm, and return once it is at rest."""
        self._command(STOP)
        self.moving = False

    def end(self) -> None:
        """Stop the arm and end the program."""
        self._command(END)

    def _command(self, kind: int) -> bool:
        """Send a command, under the next number; return whether the program carries it out."""
        with self._answered:
            self._number += 1
            self.moving |= kind == MOVE
        self._kind = kind
        deadline_s = time.monotonic() + ANSWER_S
        while time.monotonic() < deadline_s:
            self.kick()
            with self._answered:
                if self._answered.wait_for(self._is_answered, KICK_S):
                    return not self._is_stopped and self._progress % 4 != REFUSED
        raise TimeoutError(f"its program did not answer for {ANSWER_S} s")

    def _is_answered(self) -> bool:
        return self._is_stopped or self._progress // 4 == self._number

    def _await_start(self) -> tuple[float, ...]:
        """Wait for the program's first answer; return the tool centre point, which comes with it."""
        deadline_s = time.monotonic() + START_S
        while time.monotonic() < deadline_s:
            progress, *tcp = self._link.receive(START_S)[1]
            if progress == 4 * self._number + DONE:
                return tuple(tcp)
            self.kick()
        raise TimeoutError("its program does not start, the pendant may tell why")
