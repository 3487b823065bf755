"""The interpreter of URScript: what programs do, cycle by cycle, and what is refused."""

from collections.abc import Iterator

import pytest

from padforge.sense.virtual.urscript_interpreter import Pose, Program, UrscriptError


class Machine:
    """What programs call: `note` keeps a number, `wait` takes cycles."""

    def __init__(self, body: str) -> None:
        self.noted: list[float] = []
        text = "def program():\n" + body + "\nend\n"
        self.program = Program(text, {"note": self.note, "pose": self.pose}, {"sync": self.sync, "wait": self.wait})

    def note(self, value: float) -> None:
        self.noted.append(value)

    def pose(self) -> Pose:
        return Pose((1.0, 2.0, 3.0, 4.0, 5.0, 6.0))

    def sync(self) -> Iterator[None]:
        yield

    def wait(self, cycles: int, extra: int = 0) -> Iterator[None]:
        for _ in range(cycles + extra):
            yield

    def run(self, cycles: int = 1) -> list[float]:
        for _ in range(cycles):
            self.program.step()
        return self.noted


BRANCHES = """\
i = 0
while i < 4:
  i = i + 1
  if i == 2:
    note(20)
  elif i >= 3 and not (i != 3):
    note(30)
  else:
    note(i)
  end
end"""


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("note(2 * (3 + 4) - -1)", [15]),
        ("x = p[0, 1, 2.5, 3, 4, 5]\nnote(x[2] + pose()[5])", [8.5]),
        (BRANCHES, [1, 20, 30, 4]),
        ("global x = 1\ndef f():\nx = x + 1\ny = 7\nend\nf()\nf()\nnote(x)", [3]),
        ("note(1) # note(2)\n\n# end", [1]),
        ("b = (1 == 1.0)\nif b or False:\nnote(1)\nend", [1]),
    ],
)
def test_program_computes(body: str, expected: list[float]) -> None:
    assert Machine(body).run() == expected


def test_threads_take_turns_and_are_killed() -> None:
    thread = "global h = 0\nthread t():\nwhile True:\nnote(2)\nsync()\nend\nend\n"
    machine = Machine(thread + "h = run t()\nnote(1)\nwait(2, extra=1)\nkill h\nwait(2)\nnote(3)")
    noted = [len(machine.run()) for _ in range(6)]
    assert machine.noted == [1, 2, 2, 3]
    assert noted == [1, 2, 3, 3, 3, 4]
    assert not machine.program.threads


def test_end_of_the_program_ends_its_threads() -> None:
    machine = Machine("global h = 0\nthread t():\nwait(3)\nnote(1)\nend\nh = run t()\nsync()")
    assert machine.run(9) == []


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("nte(1)", "line 2, nte.1.: there is no function 'nte'"),
        ("x = nte(1)", "there is no function"),
        ("if True:\nnote(1)", "it has no end"),
        ("end\nend", "end of nothing"),
        ("else:\nend", "there is no if"),
        ("note(1", "syntax error"),
        ("x += 1", "syntax error"),
        ("note(1) note(2)", "syntax error"),
    ],
)
def test_program_does_not_compile(body: str, message: str) -> None:
    with pytest.raises(UrscriptError, match=message):
        Machine(body)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("note(x)", "x has no value"),
        ("def f():\nx = 1\nend\nf()\nnote(x)", "x has no value"),
        ("x = 1\nx = True", "x is int, and True is not"),
        ("if 1:\nend", "1 is of the wrong type"),
        ("note(True + 1)", "True is of the wrong type"),
        ("note(True)", "value has to be float, got True"),
        ("note()", "missing a required argument"),
        ("wait(1.5)", "cycles has to be int"),
        ("wait(1, cycle=1)", "unexpected keyword"),
        ("x = wait(1)", "not of the subset"),
        ("x = pose()\nnote(x[6])", "index 6"),
        ("x = 1 < 2 < 3", "not of the subset"),
        ("1", "this is no statement"),
        ("h = run nothing()", "no"),
        ("while True:\nend", "too much time"),
    ],
)
def test_program_that_cannot_go_on_ends(body: str, message: str) -> None:
    with pytest.raises(UrscriptError, match=message):
        Machine(body).run()
