import re
from types import SimpleNamespace

import pytest

from padforge import Spec
from padforge.design import Morphology
from padforge.design import compare as comparison
from padforge.design.settings import read_contact
from padforge.fabricate import FabricationSettings
from tests.helpers.door import called, refused


def test_compare_designs_every_variant_in_its_folder(tmp_path, brief):
    (tmp_path / "pad.toml").write_text("[search]\nsteps = 2\nstarts = 1\nknots = 2\n[rules]\nenforce = false\n")
    words = "design compare --vary pad.grid=1 --vary pad.pitch_mm=9,[8,12] --seed 5 --out c --profile"
    result = called(*words.split(), cwd=tmp_path)
    assert result.code == 0, result.err
    folders = sorted(path.name for path in (tmp_path / "c").iterdir() if path.is_dir())
    assert folders == ["grid-1-pitch_mm-8-x-12", "grid-1-pitch_mm-9"]
    assert "grid 1, pitch_mm 8 x 12" in result.out
    assert max(map(len, result.out.splitlines())) <= 100
    assert re.search(r"where \d+\.\d\d s went\n(.*\n)+  formats +12 of 14\n", result.err)
    pad = Morphology.load(tmp_path / "c" / folders[0] / "morphology.json")
    assert (pad.layout.counts, pad.pitch_mm, pad.provenance["seed"]) == ((1, 1), (8.0, 12.0), 5)


def test_mould_follows_varied_lengths_of_the_layer():
    """Also where the settings state another mould, as those of `padforge init` do."""
    vary = ["contact.thickness_mm=4.0,8", "contact.fibre_depths_mm=[0.25,1.25]", "contact.depth_mm=2.0"]
    spec = Spec({"mould": {"silicone_mm": 5.0, "floor_mm": 3.0}})
    variants = comparison.read_variants([], vary, lambda path: spec)
    moulds = [FabricationSettings.from_spec(variant.spec) for variant in variants]
    assert [mould.mould.silicone_mm for mould in moulds] == [4, 8]
    assert [read_contact(variant.spec).thickness_mm for variant in variants] == [4, 8]
    assert {(mould.mould.deep_ridge_height_mm, mould.mould.shallow_ridge_height_mm) for mould in moulds} == {(1.4, 0.4)}
    assert {(mould.pad.deep_family, mould.mould.floor_mm) for mould in moulds} == {("vertical", 3)}


@pytest.mark.parametrize(("names", "line"), [(("a b", "a-b"), "a-b: two pads"), (("one", "ONE"), "one: two pads")])
def test_compare_refuses_pads_of_one_folder(tmp_path, names, line):
    """The latter are two files here, and one folder on macOS and Windows."""
    for name in names:
        Morphology.straight(1).save(tmp_path / f"{name}.json")
    said = refused("design", "compare", *(f"{name}.json" for name in names), cwd=tmp_path)
    assert f"{line} have this name" in said


def test_interrupt_ends_whole_comparison(tmp_path, monkeypatch):
    started = []

    def interrupted(spec, folder, *arguments, **options):
        started.append(options["options"].time_budget)
        return {}, SimpleNamespace(stopped="interrupted")

    monkeypatch.setattr(comparison, "run_design", interrupted)
    result = called("design", "compare", "--vary", "pad.grid=1,2", "--time-budget", "7", cwd=tmp_path)
    assert (result.code, started) == (130, [7.0])
