"""Kills commands again and again, at random moments or between file operations, and looks at what they leave.

`python -m tools.kill_rounds FOLDER SECONDS [SEED [COMMAND]...]` makes pads in FOLDER, which is new, kills three of the
commands, which the seed draws, or those that are named, in turn for so long, and prints a line for each. A round begins
with the results of an earlier run in place, or with none, kills the command that replaces them, and runs it again:
files that belong together must be all old or all new, the second run must end well, and nothing else must be left.
"""

import os
import random
import secrets
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import count
from pathlib import Path

from padforge.design.common.files import read_json, recover, sha256
from padforge.design.common.validation import InputError
from padforge.sense.recording.recording import Recording
from tools.kills import KILLED, forked, kill_at

SETTINGS = """
[pad]
grid = 2
[search]
knots = 2
starts = 2
steps = 30
max_failures = 1
[rig]
presses = 60
readings_per_press = 8
rate_hz = 60
press_mm_s = 250
travel_mm_s = 500
acceleration_mm_s2 = 3000
max_force_n = "unwatched"
[localizer]
members = 1
hidden = 8
layers = 1
epochs = 8
max_failures = 1
"""
RESUMED = ("--resume",)
_VOLATILE = {"design.json", "report.html", "run.json"}
"""Files with run times in them, or digests of such."""
_PICTURES = {"error_map.png", "error_by_loss.png"}
_TOGETHER = (
    {"morphology.json", "design.svg", "design.png"},
    {"localizer.json", "localizer.safetensors", "health.json", "calibration.json", *_PICTURES},
    {f"robustness.{kind}" for kind in ("json", "csv", "png", "md")},
    {"mould.stl", "mould.step", "tracks.svg", "mould.png", "tracks.png", "laying.md", "fabrication.json"},
    {"recording"},
    {"out.csv"},
    {"out.h5"},
    {"out.mcap"},
    {"dataset"},
)
_OF_DESIGN = ("torch", "matplotlib.figure", "padforge.design.design_run")
_OF_OTHERS = (
    *("build123d", "shapely", "trimesh", "h5py", "rosbags.rosbag2", "pyarrow", "numba"),
    *("padforge.fabricate.export", "padforge.sense.localizer.training", "padforge.sense.report.sections"),
)


@dataclass(frozen=True)
class Command:
    """A command that replaces results in `pad` by those of another pad, whose inputs are in `other`.

    Attributes:
        words: of the command line. again: what may be added where it is run again; one is drawn.
        old: whether results may be there before.
    """

    words: str
    again: Sequence[tuple[str, ...]] = ((),)
    old: bool = True


COMMANDS = {
    "design": Command("design --seed 1 --force --out pad", ((), RESUMED)),
    "fabricate": Command("fabricate other/morphology.json --out pad"),
    "run": Command("run --seed 1 --formats stl,svg --out pad", ((), RESUMED)),
    "record": Command("sense record --morphology other/morphology.json --seed 1 --out pad/recording", old=False),
    "calibrate": Command("sense calibrate other/recording --out pad"),
    "study": Command("study robustness square@2 --presses 16 --max-failures 1 --seed 1 --out pad", ((), RESUMED)),
    "csv": Command("sense export other/recording pad/out.csv"),
    "hdf5": Command("sense export other/recording pad/out.h5"),
    "mcap": Command("sense export other/recording pad/out.mcap"),
    "lerobot": Command("sense export other/recording pad/dataset --format lerobot", old=False),
}
_EXPORTED = {"csv": "csv", "hdf5": "h5", "mcap": "mcap"}


def started(words: Sequence[str], folder: Path, prepare: Callable[[], None] = lambda: None) -> int:
    """Begin a command in a copy of this process; the number of that process."""

    def command() -> None:
        sys.argv = ["padforge", *words]
        import_module("padforge.cli").main()

    return forked(command, folder, prepare)


def ended(child: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def results(folder: Path) -> dict[str, str]:
    """Digests of the results in `pad`, by name, once whoever reads there has settled what was under way."""
    recover(folder / "pad")
    found = {}
    for path in (folder / "pad").iterdir() if (folder / "pad").is_dir() else ():
        if not path.name.startswith(".") and path.name not in _VOLATILE:
            found[path.name] = sha256(path)
    return found


def require_whole(folder: Path, old: dict[str, str], new: dict[str, str]) -> str:
    """See that what belongs together is all old or all new; which of it was there."""
    now, told = results(folder), set()
    for names in _TOGETHER:
        part, before, after = ({name: all_[name] for name in names & all_.keys()} for all_ in (now, old, new))
        assert part in (before, after) or (not part and "recording" in names), (sorted(names), part, before, after)
        if before != after:
            told.add("new" if part == after else "old")
    design = folder / "pad" / "design.json"
    if design.exists():
        digest = read_json(design, "padforge-design/2")["morphology_sha256"]
        assert digest == sha256(folder / "pad" / "morphology.json")
    recording = folder / "pad" / "recording"
    if (recording / "start.json").exists():
        Recording.open(recording)
    return " and ".join(sorted(told))


def litter(folder: Path) -> list[str]:
    """What no run that came to its end leaves."""
    temporary = Path(f"{folder}.tmp")
    found = [
        path for path in (*folder.rglob("*"), *temporary.rglob("*")) if path.name.startswith((".", "tmp", "padforge-"))
    ]
    return [str(path) for path in (*found, *folder.rglob("search"), *folder.rglob("*-unfinished"))]


class Rounds:
    """Rounds of one command, each in a folder of its own.

    Args:
        where: an empty folder. origin: a folder with settings, `pad` and `other`. command: what is killed.
    """

    def __init__(self, where: Path, origin: Path, command: Command) -> None:
        self._where, self._origin, self._command = where, origin, command
        where.mkdir()
        self._new: dict[bool, dict[str, str]] = {}
        self.seconds: dict[bool, float] = {}
        self.operations: dict[bool, int] = {}
        for old in {command.old, False}:
            folder = self._folder(f"unbroken-{old}", old)
            begin, counts = time.monotonic(), Path(f"{folder}.operations")

            def counted(folder: Path = folder, counts: Path = counts) -> None:
                file = counts.open("wb", buffering=0)
                kill_at(10**9, folder, lambda: file.write(b"."))

            assert ended(started(command.words.split(), folder, counted)) == 0, Path(f"{folder}.err").read_text()
            self.seconds[old] = time.monotonic() - begin
            self.operations[old] = counts.stat().st_size
            assert not litter(folder), litter(folder)
            self._new[old] = results(folder)

    def _folder(self, name: str, old: bool) -> Path:
        folder = self._where / name
        for left in self._where.glob(f"{name}*"):
            shutil.rmtree(left) if left.is_dir() else left.unlink()
        shutil.copytree(self._origin, folder, ignore=None if old else shutil.ignore_patterns("pad"))
        Path(f"{folder}.tmp").mkdir()
        return folder

    def round(self, rng: random.Random, between: bool) -> str:
        """Kill the command once, at a random moment or between file operations, and run it again; what it had left."""
        old, words = self._command.old and rng.random() < 0.7, self._command.words.split()
        folder = self._folder("round", old)
        before = results(folder)
        if between:
            number = rng.randrange(self.operations[old])
            child = started(words, folder, lambda: kill_at(number, folder))
        else:
            child = started(words, folder)
            time.sleep(rng.uniform(0, self.seconds[old]))
            os.kill(child, signal.SIGKILL)
        code = ended(child)
        assert code in (-signal.SIGKILL, KILLED, 0), (code, Path(f"{folder}.err").read_text())
        left = len(litter(folder))
        told = require_whole(folder, before, self._new[old])
        words += rng.choice(self._command.again)
        code, error = ended(started(words, folder)), Path(f"{folder}.err").read_text()
        whole_already = code == 2 and "exists and is not empty" in error and told == "new"
        assert code == 0 or whole_already, (code, error)
        require_whole(folder, self._new[old], self._new[old])
        if whole_already and left:  # it has refused before it wrote anything
            return f"{told}, refused"
        assert not litter(folder), litter(folder)
        return f"{told or 'same'}{', litter' * bool(left)}"


def made(where: Path, names: Sequence[str]) -> Path:
    """A folder with settings and the results of two pads, as far as these commands need them."""
    origin = where / "origin"
    origin.mkdir()
    (origin / "pad.toml").write_text(SETTINGS)
    Path(f"{origin}.tmp").mkdir()
    before = ["run --out pad --formats stl,svg", "run --seed 1 --out other --formats stl"]
    if {*names} == {"design"}:
        before = ["design --out pad"]
    if "study" in names:
        before.append("study robustness square@2 --presses 16 --max-failures 1 --out pad")
    before += [f"sense export pad/recording pad/out.{kind}" for name, kind in _EXPORTED.items() if name in names]
    for words in before:
        assert ended(started(words.split(), origin)) == 0, Path(f"{origin}.err").read_text()
    return origin


def main(where: Path, seconds: float, seed: int, names: Sequence[str]) -> None:
    """Kill commands in turn, at random moments and, every fourth time, between file operations, for so long."""
    rng = random.Random(seed)
    names = names or rng.sample(sorted(COMMANDS), 3)
    print(f"kills of {', '.join(names)} for {seconds:g} s, seed {seed}", flush=True)
    for name in _OF_DESIGN + (_OF_OTHERS if {*names} != {"design"} else ()):
        import_module(name)
    where.mkdir(parents=True)
    origin, failed = made(where, names), 0
    down_command = {name: Rounds(where / name, origin, COMMANDS[name]) for name in names}
    found: dict[str, Counter[str]] = {name: Counter() for name in names}
    end = time.monotonic() + seconds
    for number in count():
        name, between = names[number % len(names)], number // len(names) % 4 == 3
        try:
            found[name][down_command[name].round(rng, between)] += 1
        except (AssertionError, InputError) as error:
            failed += 1
            print(f"FAILED {name} {number} {between}: {str(error)[:1500]}", flush=True)
            shutil.copytree(where / name / "round", where / f"failed-{name}-{number}-{between}", symlinks=True)
        if time.monotonic() > end:
            break
    for name, outcomes in found.items():
        print(f"{name}: {outcomes.total()} kills: {dict(sorted(outcomes.items()))}", flush=True)
    sys.exit(failed)


if __name__ == "__main__":
    where, seconds, *more = sys.argv[1:]
    main(Path(where).resolve(), float(seconds), int(more[0]) if more else secrets.randbelow(2**32), more[1:])
