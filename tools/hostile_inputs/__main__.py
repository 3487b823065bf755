"""Hostile inputs: command lines, files and calls with something wrong, each in a process of its own, under limits.

`python -m tools.hostile_inputs FOLDER SECONDS [SEED [NUMBER]]` makes good files in FOLDER, which is new, and tries
inputs for so long, or the one of NUMBER again. Each must end in results, or in one line with nothing changed: no
traceback, no file torn or left over, at most 1 GiB of memory and 10 s of computing. Told are counts by kind and
outcome, the most memory and time, and every violation with the number of its input, whose files are kept in
FOLDER/violation-NUMBER. It refuses to run as root.
"""

import gc
import os
import secrets
import shlex
import shutil
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from contextlib import chdir
from dataclasses import dataclass, field, replace
from importlib import import_module
from itertools import count
from pathlib import Path

import numpy as np

from padforge.cli import main as padforge_main
from tools.kills import on_one_thread

from . import calls, command_lines, spoilt_files
from .judging import MOST_CPU_S, MOST_MEMORY, outcome, suspect, violations
from .limited import MIB, Ended, Limits, fresh, limited
from .texts import Rng
from .workplace import Workplace

LIBRARIES = (
    *("torch", "matplotlib.figure", "matplotlib.font_manager", "shapely", "trimesh", "h5py", "pyarrow"),
    *("rosbags.rosbag2", "scipy.io", "padforge.sense.deploy.onnx_export", "ezdxf", "lxml.etree"),
    "pymoo.core.problem",
    *("padforge.fabricate.export", "padforge.sense.report.sections", "padforge.sense.live.pipeline"),
    "padforge.sense.rig.operation",
)
"""Imported before, not by each process again; not build123d, which few need and which makes each copy take longer."""
SHARES = {"command line": 0.35, "file": 0.4, "call": 0.25}
SERVED_S = 1.0
"""How long a command that serves is let to, before it is interrupted."""
FRESH_SHARE = 0.02
"""Of command lines and files, how many the program gets as people start it, in a process that begins with nothing."""


@dataclass(frozen=True)
class Hostile:
    """An input.

    Attributes:
        kind: what of it is counted together. told: how it is repeated. work: what is done with it. words: of a command.
    """

    kind: str
    told: str
    work: Callable[[], object]
    words: tuple[str, ...] = ()


@dataclass
class Tally:
    """What the inputs of a kind have come to."""

    outcomes: Counter[str] = field(default_factory=Counter)
    memory: int = 0
    cpu_s: float = 0.0

    def add(self, ended: Ended) -> None:
        """Count another one."""
        self.outcomes[outcome(ended)] += 1
        self.memory, self.cpu_s = max(self.memory, ended.memory), max(self.cpu_s, ended.cpu_s)

    def __str__(self) -> str:
        told = ", ".join(f"{count} {name}" for name, count in self.outcomes.most_common())
        return f"{self.outcomes.total()}: {told}; at most {self.memory / MIB:.0f} MiB more, {self.cpu_s:.1f} s"


def command(*words: str) -> None:
    """The command line, in this process."""
    sys.argv = ["padforge", *words]
    padforge_main()


def drawn(rng: Rng, workplace: Workplace) -> Hostile:
    """An input, for which files in the folder are spoiled as it wants them."""
    kind = rng.choice(list(SHARES), p=list(SHARES.values()))
    if kind == "call":
        with chdir(workplace.folder):
            call, told = calls.drawn(rng)
        return Hostile(f"call {told.partition('(')[0].partition('.')[0]}", told, call)
    if kind == "command line":
        words, told = command_lines.drawn(rng), ""
        kind = f"command {' '.join(words[: 1 + (words[:1] in (['sense'], ['design'], ['fabricate'], ['study']))])}"
        kind = kind if kind.isprintable() and len(kind) < 40 else "command"
    else:
        words, told = spoilt_files.drawn(rng, workplace.folder, workplace.files())
        name = told.partition(":")[0]
        kind = f"file {Path(name).suffix or name}"
        told = f"  # {told}"
    return Hostile(kind, f"padforge {shlex.join(words)}{told}"[:3000], lambda: command(*words), tuple(words))


class Campaign:
    """Rounds of inputs in one folder.

    Args:
        where: an empty folder. seed: of all that is drawn.

    Attributes:
        tallies: by kind of input. fresh: bytes of memory that processes had which began with nothing.
    """

    def __init__(self, where: Path, seed: int) -> None:
        self._where, self._seed = where, seed
        self.workplace = Workplace(where)
        with chdir(self.workplace.master):
            calls.sound()
        calls.functions()
        self.tallies: dict[str, Tally] = defaultdict(Tally)
        self.fresh: list[int] = []
        gc.collect()
        gc.freeze()

    def round(self, number: int) -> list[str]:
        """Try an input; what of its end may not be."""
        try:
            hostile, anew = self._made(number)
        except Exception as error:  # of the libraries that spoil files: others are still to be tried
            return [f"NOT MADE {number}: {error!r}"]
        ended, found = self._tried(hostile, anew)
        if ended.cpu_s > MOST_CPU_S:  # once more, now that whatever it compiled is kept
            ended, found = self._tried(self._made(number)[0], anew)
        if anew or suspect(ended):
            memory = ended.memory if anew else self._memory_of_fresh(number)
            self.fresh.append(memory)
            found += [f"takes {memory / MIB:.0f} MiB"] * (memory > MOST_MEMORY)
        self.tallies[hostile.kind].add(replace(ended, memory=0) if anew else ended)
        if found:
            self._made(number)
            kept = self._where / f"violation-{number}"
            shutil.copytree(self.workplace.folder, kept, symlinks=True, ignore=_no_files)
            found = [f"VIOLATION {number} {hostile.kind}: {'; '.join(found)}", f"    {hostile.told}"]
        return found

    def _made(self, number: int) -> tuple[Hostile, bool]:
        """An input, in a folder as it wants it, and whether it is for a process that begins with nothing."""
        rng = np.random.default_rng([self._seed, number])
        self.workplace.renew()
        hostile = drawn(rng, self.workplace)
        return hostile, bool(hostile.words) and rng.random() < FRESH_SHARE

    def _tried(self, hostile: Hostile, anew: bool) -> tuple[Ended, list[str]]:
        """How an input ended, and what of that may not be."""
        folder, before = self.workplace.folder, self.workplace.now()
        serves = SERVED_S if {*hostile.words[:2]} & command_lines.SERVING else None
        if anew:
            ended = fresh(["-m", "padforge", *hostile.words], folder, interrupt_s=serves and 5 * serves)
        else:
            ended = limited(hostile.work, folder, Limits(), serves)
        left = list(self.workplace.temporary.iterdir())
        return ended, violations(ended, self.workplace.changed(before), left)

    def _memory_of_fresh(self, number: int) -> int:
        """Most memory of a process that begins with nothing and does the same."""
        hostile, _ = self._made(number)
        words = ["-m", "padforge", *hostile.words]
        if not hostile.words:
            script = "import numpy as np; from tools.hostile_inputs import calls; "
            script += f"rng = np.random.default_rng([{self._seed}, {number}]); rng.choice(3, p={[*SHARES.values()]}); "
            words = ["-c", script + "calls.drawn(rng)[0]()"]
        return fresh(words, self.workplace.folder).memory


def _no_files(folder: str, names: list[str]) -> set[str]:
    """What no copy is made of: it may not be read, or has no end."""
    paths = {name: Path(folder, name) for name in names}
    copied = {name for name, path in paths.items() if path.is_symlink() or path.is_file() or path.is_dir()}
    return {*names} - {name for name in copied if paths[name].is_symlink() or os.access(paths[name], os.R_OK)}


def main(where: Path, seconds: float, seed: int, first: int | None = None) -> int:
    """Try inputs for so long, or the one of number `first`, and tell of them; how many had an end that may not be."""
    if os.geteuid() == 0:
        sys.exit(
            "hostile inputs name devices and files of others: run this as a user who may harm nothing, not as root"
        )
    print(f"hostile inputs for {seconds:g} s, seed {seed}", flush=True)
    os.environ |= {"CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
    for name in LIBRARIES:
        import_module(name)
    where.mkdir(parents=True)
    campaign, failed = Campaign(where, seed), 0
    end = time.monotonic() + seconds
    for number in count(first or 0):
        found = campaign.round(number)
        failed += bool(found)
        for line in found:
            print(line, flush=True)
        if first is not None or time.monotonic() > end:
            break
    for kind, tally in sorted(campaign.tallies.items()):
        print(f"{kind:<28} {tally}")
    fresh_mib = max(campaign.fresh, default=0) / MIB
    print(f"{len(campaign.fresh)} of them in a process that began with nothing: at most {fresh_mib:.0f} MiB")
    tried = sum(tally.outcomes.total() for tally in campaign.tallies.values())
    print(f"{tried} inputs, {failed} violations")
    return failed


if __name__ == "__main__":
    on_one_thread()
    where, seconds, *more = sys.argv[1:]
    seed, *first = map(int, more or [secrets.randbelow(2**32)])
    sys.exit(main(Path(where).resolve(), float(seconds), seed, *first) > 0)
