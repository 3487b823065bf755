"""What a command cannot do is one line that says why, and leaves nothing."""

import json
import re
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
from tests.helpers.door import contents
from tests.helpers.golden import FOLDER, Golden
from tests.helpers.once import Once
from tests.sense.cli.conftest import FEW, Run
from tests.sense.conftest import first_presses

OTHERS_WORDS = [rf"(?<={words} )\(.*\)" for words in ("be written", "be read", "MATLAB file")]


@pytest.fixture(scope="module")
def workshop(once: Once, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `few` has, and things that are not what they should be."""
    folder = shutil.copytree(once(*FEW), tmp_path_factory.mktemp("refused") / "workshop")
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


def test_invalid_commands_fail_in_one_line(padforge_sense: Run, workshop: Path, golden: Golden, monkeypatch) -> None:
    """Those of the kept file, with all that they say: a new one is a line of it that begins with $."""
    monkeypatch.setattr("padforge.sense.localizer.training.RETRAINING_STEPS", 1)
    monkeypatch.setattr("padforge.sense.rig.boards.due.list_due_ports", list)
    monkeypatch.chdir(workshop)
    before, said = contents(workshop), list[str]()
    with LivePage(0) as page:
        taken = page.url.rstrip("/").rsplit(":", 1)[1]
        for words in re.findall(r"^\$ (.*)", (FOLDER / "cli/refusals.txt").read_text("utf-8"), re.MULTILINE):
            code, out, err = padforge_sense(*shlex.split(words.replace("{taken}", taken)))
            assert (code, out) == (2, ""), words
            assert err.splitlines()[-1].startswith("padforge: "), words
            assert contents(workshop) == before, words
            said += [f"$ {words}", *err.replace(taken, "{taken}").replace(str(workshop), "<workshop>").splitlines(), ""]
    golden("cli/refusals.txt", "\n".join(said).rstrip(), forget=[*OTHERS_WORDS, r"(?<=--token )\S{16,}"])
