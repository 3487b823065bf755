"""Hostile command lines: every command with its options, as click knows them, and about one thing wrong."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import chain

import click

from padforge.cli import cli

from .texts import Rng, pick
from .values import HOSTILE, PATHS
from .workplace import BAG, LAB, LAB_H5

FOLDERS = ("new", "pad", "new/deep", "empty")
RECORDINGS = ("pad/recording", "presses.csv", "presses.h5", "presses.mcap", "long")
PADS = ("pad/morphology.json", "pad.mat")
RIGHT: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("morphology", "--morphology", "pad"), PADS),
    **dict.fromkeys(("recording", "--replay"), RECORDINGS),
    "--spec": ("pad.toml", "other.toml"),
    "--out": FOLDERS,
    "--model": ("pad", "again"),
    "--twin": ("pad/twin.json",),
    "--start-from": ("random", "straight", "pad/morphology.json"),
    "--knots": ("1", "2"),
    "--starts": ("1",),
    "--device": ("cpu",),
    "--time-budget": ("0", "1e-3", "0.5"),
    "--scheduler": ("nobody.invalid:1", "x", "tcp://127.0.0.1:1"),
    "--vary": ("pad.grid=1,2", "search.knots=1"),
    "--formats": ("stl", "svg", "", "gcode", "step"),
    "--picture": ("new.png",),
    "--columns": (LAB, LAB_H5, BAG, "fibres=*", "time=time_s:ms,fibres=fibre?:mV"),
    "--exclude-fibres": ("1", "1,2,3"),
    "--rig": ("simulated", "ur5", "printer", "hand"),
    "--presses": ("4", "5", "16"),
    "--plan": ("plan.csv", "grid", "uniform", "adaptive"),
    "--port": ("0",),
    "--tcp": ("0",),
    "--foxglove": ("0",),
    "--rerun": ("new.rrd",),
    "--host": ("127.0.0.1", "localhost"),
    "--token": ("word",),
    "--speed": ("1e6", "1e300"),
    "--flash": ("64k", "1M"),
    "--ram": ("16k", "64k"),
    "--grids": ("2", "2,4"),
    "--against": ("nothing.json", "list.json", "pad/design.json"),
    "--max-failures": ("0", "1"),
    "--jobs": ("1",),
    "plan": ("plan.svg", "plan.dxf"),
    "mesh_or_morphology": (*PADS, "pad/mould.stl", "pad/mould.3mf"),
    "file": ("presses.csv", "presses.h5", "lab.csv", "bag_mcap", "new.csv", "new.h5", "new.mcap"),
    "files": ("new.onnx", "pad/recording"),
    "sources": ("pad/morphology.json", "other.toml"),
    "names": ("no-such-pad", "square@999", "random-100"),
    "path": ("new.toml",),
    "folder": ("pad", "empty"),
}
"""Values that suit an argument or option of that name, wherever it is."""
ALWAYS = {"--speed": "1e6", "--port": "0", "--formats": "stl", "--model": "pad", "--time-budget": "0.1"}
"""What a command is given that has the option: without, it lasts as long as the recording, takes a port that others
may have, or is about CAD or the defaults, which take long."""
EMPTY = {"file", *(f"nothing.{kind}" for kind in ("json", "stl", "mat", "toml", "csv", "h5"))}
"""Files that stand for the defaults where they are taken for settings: a training by these takes minutes."""
SERVING = {"edit", "live", "record", "doctor"}
"""They wait for people or devices, until they are interrupted."""


@dataclass(frozen=True)
class Command:
    """A command: its words, and values that suit its arguments, in order, and options; None for a flag."""

    words: tuple[str, ...]
    arguments: tuple[tuple[str, ...], ...]
    options: dict[str, tuple[str, ...] | None]


@cache
def commands() -> tuple[Command, ...]:
    """All there are, by what click says of them."""

    def found(command: click.Command, words: tuple[str, ...]) -> Iterator[Command]:
        arguments = [_right(each) for each in command.params if isinstance(each, click.Argument)]
        options = {each.opts[0]: _right(each) for each in command.params if isinstance(each, click.Option)}
        yield Command(words, tuple(values for values in arguments if values), options)
        for name, inner in getattr(command, "commands", {}).items():
            yield from found(inner, (*words, name))

    return tuple(found(cli, ()))


def _right(parameter: click.Parameter) -> tuple[str, ...] | None:
    name, kind = parameter.opts[0], parameter.type
    if isinstance(parameter, click.Option) and parameter.is_flag:
        return None
    if name in RIGHT:
        return RIGHT[name]
    if isinstance(kind, click.Choice):
        return tuple(kind.choices)
    ends = [end for end in (getattr(kind, "min", None), getattr(kind, "max", None)) if end is not None]
    return tuple(map(str, ends)) or ("1",)


def drawn(rng: Rng) -> list[str]:
    """A command line with about one thing wrong, or several, or none; rarely, with words in any order."""
    command = pick(rng, commands())
    one_in = pick(rng, (1, 3, 6))

    def value(right: tuple[str, ...]) -> str:
        if rng.integers(one_in) == 0:
            return pick(rng, pick(rng, (PATHS, HOSTILE, tuple(chain.from_iterable(RIGHT.values())))))
        return pick(rng, right)

    words = [[value(right)] for right in command.arguments]
    names = rng.permutation(sorted(command.options))[: rng.integers(5)].tolist()
    for name in (*names, *(name for name in ALWAYS if name in command.options and name not in names)):
        right = command.options[name]
        if name not in names:
            words.append([name, ALWAYS[name]])
        else:
            words.append([name] if right is None else [name, value(right)])
            words[-1] = ["--spec", "pad.toml"] if name == "--spec" and words[-1][1] in EMPTY else words[-1]
    _misuse(rng, words)
    if command.words[:1] in (("study",), ("bench",)) and "--against" not in names:
        words.append(["no-such-one"])  # else it takes minutes
    return [*command.words, *chain.from_iterable(words[at] for at in rng.permutation(len(words)))]


def _misuse(rng: Rng, words: list[list[str]]) -> None:
    """Now and then leave a word out, double one, or put in what no command knows."""
    at, kind = int(rng.integers(len(words))) if words else 0, int(rng.integers(20))
    if kind == 0:
        words.append([pick(rng, HOSTILE)])
    elif kind == 1 and words:
        words.pop(at)
    elif kind == 2 and words:
        words[at] = words[at][:-1]
    elif kind == 3 and words:
        words.append(words[at])
    elif kind == 4:
        words.append([pick(rng, ("--no-such-option", "-x", "--out", "--seed=", "--spec=", "--json=1", "--", "--help"))])
