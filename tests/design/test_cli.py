"""Commands of design: where their results go."""

import pytest
from click.testing import CliRunner

from design import InputError, Morphology
from design.cli import design


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
