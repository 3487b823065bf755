"""What a command cannot do is one line that says why, and leaves nothing."""

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from padforge.benchmarks.twin import printed_pad
from padforge.common.files import sha256
from padforge.design import Morphology
from padforge.design.twin import TwinChannel
from padforge.fabricate import MouldSettings, build
from padforge.fabricate.settings import DEFAULTS
from padforge.sense import Recording
from padforge.sense.live.outputs import LivePage
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.simulated_recording import simulate
from tests.sense.conftest import first_presses

ROWS = """
import noise.mat --out r                        | noise.mat
import empty                                    | or a rosbag2 folder
import noise.csv --out pad.toml/r               | pad.toml
import noise.csv --columns time=t,fibres=b --out r  | noise.csv: time is 't', expected one of 'a', 'b'
export rec set --model model                    | allowed are .csv, .h5, .mcap, or --format lerobot
export rec pad.toml/r.csv                       | pad.toml
export rec model --format lerobot               | model: exists and is not empty
calibrate pad.toml --out m                      | pad.toml: no recording, expected a folder
calibrate model --out m                         | model: no recording, expected {recording}
import model/localizer.json                     | model/localizer.json: ends in '.json', allowed are .mat, .csv
evaluate rec                                    | Missing option '--model'. Folder that calibrate wrote.
evaluate --model empty rec                      | empty: no localizer.json, expected a folder that `padforge sense
fibre-loss rec --out m                          | neither --model nor --retrain is given
fibre-loss rec --model model --failed 5         | fibre 5: no such fibre, allowed are 1 to 4
calibrate rec --out pad.toml/model              | pad.toml is a file, expected a folder
evaluate --model model other --max-failures 0           | readings are of 6 fibres, the localizer was learnt from 4
locate --model model rec --out pad.toml/p.csv   | pad.toml/p.csv: cannot be written
locate --model model rec --exclude-fibres 1,0 --out p.csv | padforge: fibre 0: no such fibre, allowed are 1 to 4
health --model model rec                        | health
calibrate rec --seed 5 --out studied            | localizer.json: fibre_loss.json was made from it; choose another
recalibrate --model model less --out studied    | localizer.json: fibre_loss.json was made from it; choose another
identify rec {straight} --out designed          | twin.json: design.json was made from it; choose another --out
recalibrate --model model rec {five} --out n    | pad has 10 fibres, the recording 4; expected as many
calibrate rec {five} --out n                    | pad has 10 fibres, the recording 4; expected as many
recalibrate --model empty/../model model/recording | padforge: model: holds the old model; name a folder
deploy --model model localizer.tflite           | localizer.tflite: cannot be written, expected a name that ends in
deploy --model model other l.onnx               | readings are of 6 fibres, the localizer was learnt from 4
record --seed 9 --out rec                       | never written over
record --presses -3 --out rec                   | Invalid value for '--presses': got -3, input should be greater
record --plan rows --out rec                    | Invalid value for '--plan': got 'rows', expected uniform, grid,
record --plan adaptive                          | --plan is adaptive, which needs a real rig
record --resume                                 | --resume, --dry-run and --model need a real rig
record --mcap --out rec2                        | rec2.mcap: exists, recordings are never written over; choose
record --mcap --dry-run --rig ur5 {five}        | --mcap exports what is recorded, and --dry-run keeps nothing
record --twin twin.json --rig ur5               | --twin is of the simulated pad, allowed with --rig simulated
record --twin dead.json                         | twin: none of its channels reads a fibre
record --rig printer {straight}                 | [rig] tcp_mm is unknown, allowed are x, y and z of the probe's tip
record --rig ur5 --spec none.toml               | --morphology is needed, of the pad under the arm: there is none at
record --rig ur5 --spec 3.toml --out mine/r     | [rig] channels: got 3 inputs, the pad has 4 fibres
record --rig ur5 {unread} --plan adaptive       | [rig] plan is adaptive, which needs --model
record --rig hand {straight} --dry-run          | --dry-run and --model need an arm
doctor --rig ur5 --spec 3.toml {five}           | [rig] channels: got 3 inputs, the pad has 10 fibres
doctor --rig crane                              | --rig is 'crane', allowed are hand, printer, ur5
doctor --rig simulated                          | --rig is 'simulated', allowed are hand, printer, ur5
record {thin/morphology}                        | presses 5 mm deep, allowed is less than 4 mm, by thin/fabrication.json
record --rig ur5 {thin/morphology}              | presses 5 mm deep, allowed is less than 4 mm, by thin/fabrication.json
record --rig hand {thin/morphology}             | presses 5 mm deep, allowed is less than 4 mm, by thin/fabrication.json
record --rig crane                              | --rig is 'crane', allowed are simulated, hand, printer, ur5
{live} --model model --rig crane                | --rig is 'crane', allowed are simulated, hand, printer, ur5
calibrate rec --time-budget 0                   | Invalid value for '--time-budget': 0.0 is not in the range x>0
calibrate rec --without radii                   | Invalid value for '--without': 'radii' is not one of 'health'
calibrate rec --time-budget nan                 | Invalid value for '--time-budget': got 'nan', expected a finite number
{live} --model model --port {taken}             | port {taken} of 127.0.0.1: another program uses it
{live} --model model --replay other             | readings are of 6 fibres, the localizer was learnt from 4
{live} --model model --rig ur5                  | no board is found
{live} --model model --host 0.0.0.0             | host is '0.0.0.0', which other machines can reach
{live} --model model --replay rec --tcp 0 --rerun here | --rerun is 'here', expected an address like rerun+http://HOST:PORT
{live} --model model --tcp 0 --token short      | token has 5 characters, allowed are 16 or more
"""
SHORT = {name: f"--morphology {name}.json" for name in ("straight", "five", "thin/morphology")}
SHORT |= {"live": "live --port 0", "unread": "--morphology straight.json --spec none.toml"}


@pytest.fixture(scope="module")
def workshop(few_presses: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `few` has, and things that are not what they should be."""
    folder = shutil.copytree(few_presses, tmp_path_factory.mktemp("refused") / "workshop")
    (folder / "noise.mat").write_bytes(b"no matlab" * 100)
    (folder / "rec2.mcap").write_bytes(b"")
    (folder / "noise.csv").write_text("a,b\n1,2\n")
    for name in ("empty", "mine", "designed", "thin"):
        (folder / name).mkdir()
    for name, grid in (("straight", 2), ("five", 5), ("mine/morphology", 2), ("thin/morphology", 2)):
        Morphology.straight(grid).save(folder / f"{name}.json")
    build(Morphology.straight(2), folder / "thin", ["svg"], replace(DEFAULTS, mould=MouldSettings(silicone_mm=4.0)))
    (folder / "none.toml").write_text('[rig]\nport = "none"\n')
    (folder / "3.toml").write_text('[rig]\nport = "none"\nchannels = [4, 0, 7]\n')
    simulate(Morphology.straight(3), RigSettings(presses=30)).save(folder / "other", {})
    first_presses(Recording.open(folder / "rec"), 20).save(folder / "less", {})
    shutil.copytree(folder / "model", folder / "studied")
    made_by = json.loads((folder / "model/localizer.json").read_text())["provenance"]
    (folder / "studied/fibre_loss.json").write_text(json.dumps({"provenance": {"inputs": {"localizer": made_by}}}))
    Recording.open(folder / "rec").save(folder / "model/recording", {})
    designed = folder / "designed"
    (designed / "twin.json").write_text('{"provenance": {"seed": 1}}')
    of_twin = {"provenance": {"inputs": {"twin.json": sha256(designed / "twin.json")}}}
    (designed / "design.json").write_text(json.dumps(of_twin))
    twin = printed_pad(Morphology.random(2, 3, 5), np.random.default_rng(3))
    twin.save(folder / "twin.json")
    replace(twin, channels=(TwinChannel(0, None, 0.0, 0.0, 0.0),)).save(folder / "dead.json")
    return folder


@pytest.mark.parametrize(("words", "said"), [row.split(" | ", 1) for row in ROWS.strip().splitlines()])
def test_invalid_command_fails_in_one_line(padforge_sense, workshop: Path, monkeypatch, words: str, said: str) -> None:
    monkeypatch.setattr("padforge.sense.localizer.training.RETRAINING_STEPS", 1)
    monkeypatch.setattr("padforge.sense.rig.boards.due.list_due_ports", list)
    monkeypatch.chdir(workshop)
    before = {path: path.stat().st_mtime_ns for path in workshop.rglob("*") if path.is_file()}
    with LivePage(0) as page:
        meant = SHORT | {"taken": page.url.rstrip("/").rsplit(":", 1)[1], "recording": str(Path("model/recording"))}
        code, out, err = padforge_sense(*shlex.split(words.format(**meant)))
    *notes, last = err.splitlines()
    assert (code, out) == (2, "")
    assert last.startswith("padforge: ")
    assert said.format(**meant) in last
    assert not [note for note in notes if note.startswith(("page: ", "lines: ", "foxglove: "))]
    assert notes == [] or words.startswith(("{live}", "calibrate")) or "--resume" in words
    assert {path: path.stat().st_mtime_ns for path in workshop.rglob("*") if path.is_file()} == before
    assert not {"out", "r", "recording", "m", "set"} & {path.name for path in workshop.iterdir()}
