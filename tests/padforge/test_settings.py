from pathlib import Path

import pytest

from padforge import InputError, Spec
from padforge.design import Contact, Morphology
from padforge.fabricate import FabricationSettings
from padforge.run import Run, check_run
from padforge.settings import check_settings
from tests.helpers.door import called, refused
from tests.helpers.golden import Golden

THIN = '[contact]\nthickness_mm = 4\ndepth_mm = 2.5\ntool = "ball"\n[mould]\nsilicone_mm = 4\n'
CONTRADICTIONS = [
    THIN + "[rig]\ndepth_mm = 5\n",
    "[contact]\ndepth_mm = 60\nthickness_mm = 70\n",
    "[contact]\nthickness_mm = 7\n[mould]\nsilicone_mm = 8\n",
    "[contact]\nfibre_depths_mm = [1.05, 0.45]\n[mould]\nshallow_ridge_height_mm = 0.4\n",
    '[contact]\nfibre_depths_mm = [0.25, 1.05]\n[pad]\ndeep_family = "horizontal"\n',
    "[pad]\ngrid = 3\n[rig]\nchannels = [0, 1]\n",
    "[pad]\npitch_mm = 3\n",
    "[pad]\nsensed_mm = [80, 10]\n",
]


def test_every_command_refuses_sections_that_contradict_each_other(tmp_path: Path, golden: Golden) -> None:
    Morphology.straight(2).save(tmp_path / "morphology.json")
    lines = []
    for text in CONTRADICTIONS:
        (tmp_path / "pad.toml").write_text(text)
        commands = ("design check morphology.json", "fabricate check morphology.json", "run")
        said = dict.fromkeys(refused(*command.split(), cwd=tmp_path) for command in commands)
        lines += [" ".join(text.split()), *(f"  {line.strip()}" for line in said)]
    golden("padforge/contradictions.txt", "\n".join(lines))


def test_thin_pad_is_pressed_as_deep_as_it_is_designed_for(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Without a word, which it takes only if the rig presses otherwise."""
    (tmp_path / "thin.toml").write_text(THIN)
    check_run(Run(Spec.load(tmp_path / "thin.toml"), tmp_path / "out"))
    assert not caplog.records
    (tmp_path / "thin.toml").write_text(THIN + "[rig]\ndepths_mm = [1, 3]\n")
    check_run(Run(Spec.load(tmp_path / "thin.toml"), tmp_path / "out"))
    assert caplog.messages == ["[rig] presses 1 to 3 mm deep, the pad is designed for presses of 2.5 mm"]


SIGNALLING = "design score morphology.json", "sense record --presses 4", "design compare morphology.json other.json"


@pytest.mark.parametrize("command", SIGNALLING)
def test_commands_say_once_that_a_layer_is_strained_too_much(tmp_path: Path, command: str, brief: None) -> None:
    for name in ("morphology", "other"):
        Morphology.straight(1).save(tmp_path / f"{name}.json")
    (tmp_path / "pad.toml").write_text('[pad]\ngrid = 1\n[contact]\nbase = "bonded"\n')
    ended = called(*command.split(), cwd=tmp_path)
    assert ended.code == 0, ended
    assert ended.err.count("[contact] strains the silicone by up to 1.0") == 1


def test_studies_press_the_pad_as_it_will_be_cast(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    contacts = []

    def force_study(pads: object, seed: int, contact: Contact) -> None:
        contacts.append(contact)
        raise InputError("seen")

    monkeypatch.setattr("padforge.sense.studies.indentation.force_study", force_study)
    (tmp_path / "pad.toml").write_text("[contact]\ndepth_mm = 6.5\n[mould]\nsilicone_mm = 8\n")
    assert called("study", "force", "square", "--spec", "pad.toml", cwd=tmp_path).code == 2
    assert [(contact.depth_mm, contact.thickness_mm) for contact in contacts] == [(6.5, 8.0)]


def test_mould_follows_contact_where_it_leaves_the_pad_open() -> None:
    contact = {"thickness_mm": 8.0, "fibre_depths_mm": [6.45, 7.65]}  # pressed on the face without tracks
    spec = Spec({"contact": contact, "mould": {"floor_mm": 3.0, "deep_ridge_height_mm": 1.7}})
    check_settings(spec)
    cast = FabricationSettings.from_spec(spec)
    heights_mm = cast.mould.deep_ridge_height_mm, cast.mould.shallow_ridge_height_mm
    assert (cast.mould.silicone_mm, cast.mould.floor_mm, heights_mm) == (8.0, 3.0, (1.7, 0.5))
    assert cast.pad.deep_family == "horizontal"
    measured = Spec({"contact": {"thickness_mm": 6.1}, "mould": {"silicone_mm": 6.0}})
    assert FabricationSettings.from_spec(measured).mould.silicone_mm == 6.0
