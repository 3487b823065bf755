import json
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from click.testing import CliRunner

from padforge import Spec, design
from padforge.design import Contact, Morphology, PadSettings, SearchSettings, Twin, cli, signals
from padforge.design.layer import solve_press
from padforge.design.objectives.ambiguity import free_presses
from padforge.design.optimize.search import settings_for_twin
from padforge.design.paths.import_plan import import_plan
from padforge.design.paths.keep_outs import check_fibre_ends
from padforge.design.settings import Layout
from tests.design.objectives.pads import square
from tests.helpers.golden import Golden
from tests.helpers.refusals import refusal_table

CAUSE, NUMPY = r"(?<=read \(|file \(|twin \(|logy \().*(?=\))", ("operands.*", "could not convert.*")
"""Words of Python and of other libraries."""

PAD = Morphology.straight(2)
KNOTS = Morphology.random(2, 1, seed=0).knots
UNSORTED = np.array([[[0, 1.0], [1, 0.2], [1 + 2.0**-52, 1.8], [2, 1.0]]] * 2)
UNSORTED[1] = UNSORTED[1, :, ::-1]


def knots_of(change: Callable[[Any], Any]) -> Callable[[], Morphology]:
    return lambda: Morphology(change(KNOTS))


def keep_out(*polygon: Any) -> Callable[[], None]:
    """A pad of 56 by 60 mm with a keep-out, and presses on it."""

    def use() -> None:
        size = PadSettings(keep_out_mm=(polygon,), **Layout.create((3, 6), (8.0, 15.0)).settings)
        free_presses(size)
        check_fibre_ends(size, design.RulesSettings())

    return use


def depths(depths_mm: object) -> Callable[[], object]:
    return lambda: design.indented_signals(PAD, [[1, 1], [2, 2]], depths_mm, Contact())  # pyright: ignore[reportArgumentType]


VALUES: dict[str, Callable[[], object]] = {
    "knots that are NaN": knots_of(lambda k: k * np.nan),
    "knots beyond the far side": knots_of(lambda k: k + 0.1),
    "knots beyond the near side": knots_of(lambda k: k - 0.1),
    "knots that do not ascend": knots_of(lambda k: np.concatenate([k[:3], k[3:, [0, 2, 1]]])),
    "a fibre that begins inside": knots_of(lambda k: np.where(np.arange(3)[:, None] == 0, k + 0.1, k)),
    "a fibre whose ends differ": knots_of(lambda k: k - 0.1 * (np.arange(24).reshape(4, 3, 2) == 5)),
    "a pitch": lambda: Morphology.straight(2, 1e9),
    "tiles": lambda: Morphology.straight(4).tiled(10**4),
    "knots of no pad": lambda: signals(np.zeros((3, 2, 2)), [[1, 1]]),
    "knots of signals that are NaN": lambda: signals(np.full((4, 2, 2), np.nan), [[1, 1]]),
    "knots of signals that do not ascend": lambda: signals(UNSORTED, [[1, 1]]),
    "presses that are NaN": lambda: signals(PAD, [[np.nan, 1]]),
    "presses of three numbers": lambda: signals(PAD, [[1, 2, 3]]),
    "sampled presses that are NaN": lambda: design.signals_quantized(PAD, [[np.nan, 1]]),
    "a precision": lambda: signals(PAD, [[1, 1]], Contact(), precision=1e-7),
    "depths of a profile": lambda: design.indented_signals(PAD, [[1, 1]], 0.1, Contact(model="profile")),
    "depths of a shape": lambda: design.indented_signals(PAD, [[1, 1]], 0.1, Contact(radius=0.6)),
    "a depth beyond the contact's": depths([0.1, 5.1]),
    "a depth below 0": depths([0.1, -0.1]),
    "depths of another number": depths([0.1]),
    "a tool too wide for the layer": lambda: solve_press("flat", 1000.0, 0.05, 0.1),
    "a keep-out that crosses itself": keep_out((0, 0), (4, 4), (4, 0), (0, 4)),
    "a keep-out of two corners": keep_out((0, 0), (4, 4)),
    "a keep-out beside the pad": keep_out(*square(100, 0, 4)),
    "a screw by an end": keep_out(-25.0, -15.0, 4.0),
    "a keep-out by an end": keep_out(*square(-25.0, -15.0, 4)),
    "a keep-out of all": keep_out((-28, -30), (28, -30), (28, 30), (-28, 30)),
    "a sensed area": lambda: design.score(Morphology.straight(3), pad_settings=PadSettings(sensed_mm=(46, 20))),
    "too many fibres to compare": lambda: design.score(Morphology.random(16, 3000, seed=0), max_failures=0),
    "no noise": lambda: design.score(PAD, noise=0.0),
    "an origin of other fibres": lambda: design.search(PadSettings(grid=2), origin=Morphology.straight(3)),
    "a population": lambda: design.search(settings=SearchSettings(method="genetic", population=100_000)),
    "a time budget": lambda: design.SearchOptions(time_budget=-1),
    "a report of progress": lambda: design.SearchOptions("start 1"),  # pyright: ignore[reportArgumentType]
    "options of a search": lambda: design.search(run={"resume": True}),  # pyright: ignore[reportArgumentType]
    "positions": lambda: PAD.to_mm([1.0, 2.0, 3.0]),
}


def test_refusals_of_values(golden: Golden) -> None:
    golden("design/refusals.txt", refusal_table(VALUES))
    keep_out(*square(-24.0, -15.0, 4))()  # just far enough from the end


def test_refusals_of_twins(golden: Golden, twin: Path, tmp_path: Path) -> None:
    whole, path = Twin.load(twin), tmp_path / "twin.json"

    def with_value(value: Any, *way: str) -> Callable[[], Spec]:
        def load() -> Spec:
            document = json.loads(twin.read_text())
            reduce(dict.__getitem__, way[:-1], document)[way[-1]] = value
            path.write_text(json.dumps(document))
            return settings_for_twin(Spec({}), path)

        return load

    rows: dict[str, Callable[[], object]] = {
        "presses of three numbers": lambda: whole.as_built_stretch([[1.0, 2.0, 3.0]]),
        "presses that are NaN": lambda: whole.as_built_stretch([[np.nan, 0.0]]),
        "no such part": lambda: whole.as_built_stretch([[0.0, 0.0]], "of"),
        "a file of another kind": with_value("padforge-design/1", "format"),
        "a file of other channels": with_value([{"gain": 1}], "channels"),
        "no channel that responds": with_value([asdict(replace(whole.channels[0], gain_v=0.0))], "channels"),
    }
    golden("design/refusals_of_twins.txt", refusal_table(rows).replace(str(path), "twin.json"), forget=[CAUSE])


RECTANGLE = Morphology.random(Layout.create((1, 2), (8.0, 15.0)), 2, seed=0).to_dict()
FILES = {
    "pad.json": [
        *("", "[]", '{"format": "padforge-morphology/1"}'),
        *(RECTANGLE | {"fibres": value} for value in ([2, 1], 3, ["1", "2"], [0, 0])),
        *(RECTANGLE | {"pitch_mm": value} for value in ([8.0, -1], [8.0])),
        *(RECTANGLE | {"knots": value} for value in ([], "many", Morphology.straight(2).to_dict()["knots"])),
    ],
    "plan.svg": ["nonsense", "<html/>"],
    "plan.dxf": ["nonsense", "  0\nSECTION\n  2\nHEADER\n"],
    "plan.pdf": [""],
}


def test_refusals_of_files(golden: Golden, here: Path) -> None:
    rows: dict[str, Callable[[], object]] = {}
    for name, contents in FILES.items():
        for number, content in enumerate(contents):
            path = here / str(number) / name
            path.parent.mkdir(exist_ok=True)
            path.write_text(content if isinstance(content, str) else json.dumps(content))
            read = Morphology.load if name == "pad.json" else lambda path: import_plan(path, Layout.create(2), 0.05)
            rows[f"{number}/{name}"] = lambda read=read, path=path: read(path)
    golden("design/refusals_of_files.txt", refusal_table(rows), forget=[CAUSE, *NUMPY])


SEARCH = "[search]\nknots = 2\nstarts = 1\nsteps = 3\n"
COMMANDS = [
    (["import", "plan.svg"], "[rules]\nlost = 1\n"),
    (["show", "pad/morphology.json", "--out", "a.pdf"], ""),
    (["--twin", "twin.json"], SEARCH + "[contact]\nradius = 0.9\n"),
    (["--twin", "twin.json"], SEARCH + "[pad]\ngrid = 4\n"),
    (["--twin", "none.json"], SEARCH),
    (["edit", "missing.json"], ""),
    (["edit", "pad.json", "--out", "pad.mat"], ""),
    (["edit", "pad.json", "--out", "pad.json/x.json"], ""),
]


def test_commands_refuse_before_they_write(golden: Golden, here: Path, twin: Path) -> None:
    Path("plan.svg").touch()
    Path("twin.json").write_bytes(twin.read_bytes())
    PAD.save("pad.json")

    def run(arguments: list[str], spec: str) -> object:
        Path("pad.toml").write_text(spec)
        return CliRunner().invoke(cli.design, arguments, catch_exceptions=False)

    rows = {f"{' '.join(each[0])} {number}": lambda each=each: run(*each) for number, each in enumerate(COMMANDS)}
    golden("design/refusals_of_commands.txt", refusal_table(rows), forget=[CAUSE])
    assert sorted(path.name for path in here.iterdir()) == ["pad.json", "pad.toml", "plan.svg", "twin.json"]
