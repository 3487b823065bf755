"""Commands of design: where their results go."""

import json

import pytest
from click.testing import CliRunner

from design import Contact, InputError, Morphology
from design.cli import design
from design.criteria.score import ambiguities
from design.settings import SearchSettings

QUICK = "[pad]\ngrid = 2\n[search]\nknots = 2\nstarts = 1\nsteps = 3\nlost = 1\n"


def test_straight_fibres_are_told_beside_what_was_found(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pad.toml").write_text(QUICK)
    told = CliRunner().invoke(design, [], catch_exceptions=False).output.splitlines()
    document = json.loads((tmp_path / "out/pad/design.json").read_text())
    straight = ambiguities(Morphology.straight(2), Contact(), 1, SearchSettings().noise)
    assert list(document["straight"].values()) == pytest.approx(straight, rel=1e-6)
    assert set(document["straight"]) == {name for name in document["terms"] if name.startswith("ambiguity")}
    assert told[1].startswith(
        "  ambiguity {ambiguity_lost_0:.3f} / {ambiguity_lost_1:.3f} ".format(**document["terms"])
    )
    assert told[2].split() == f"{straight[0]:.3f} / {straight[1]:.3f} with straight fibres".split()


def test_the_plan_goes_to_the_folder_of_the_pad_unless_told_otherwise(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Morphology.straight(2).save(tmp_path / "pad" / "morphology.json")
    shown = CliRunner().invoke(design, ["show", "pad/morphology.json"], catch_exceptions=False)
    assert shown.output == "plan -> pad/plan.svg\n"
    assert (tmp_path / "pad" / "plan.svg").exists()
    CliRunner().invoke(design, ["show", "pad/morphology.json", "--out", "a.png"], catch_exceptions=False)
    assert (tmp_path / "a.png").exists()
    with pytest.raises(InputError, match=r"--out is a\.pdf, allowed are \.svg and \.png"):
        CliRunner().invoke(design, ["show", "pad/morphology.json", "--out", "a.pdf"], catch_exceptions=False)
