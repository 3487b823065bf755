"""Commands of design: where their results go."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from design import Contact, InputError, Morphology, SearchRun, Spec, Twin, score, search
from design.cli.main import design
from design.common.files import sha256
from design.common.settings import commented_toml
from design.criteria.score import AMBIGUITY_NOISE, ambiguities
from design.evaluation.expected_error import error_terms, expected_errors, straight_full_scale
from design.optimisers.twin_search import state_folders
from design.pad.twin import Frame, TwinChannel
from design.report.files import found_before, search_lines
from design.report.twin_settings import settings_for_twin
from design.settings import PadSettings, SearchSettings

QUICK = "[pad]\ngrid = 2\n[search]\nknots = 2\nstarts = 1\nsteps = 3\nlost = 1\n"


def test_straight_fibres_are_told_beside_what_was_found(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pad.toml").write_text(QUICK)
    told = CliRunner().invoke(design, [], catch_exceptions=False).output.splitlines()
    document = json.loads((tmp_path / "out/pad/design.json").read_text())
    pad, asked = Morphology.straight(2), {"lost": 1, "size": PadSettings(grid=2)}
    straight = [
        *expected_errors(pad, Contact(), SearchSettings(lost=1), asked["size"]),
        *ambiguities(pad, Contact(), noise=AMBIGUITY_NOISE, **asked),
    ]
    assert list(document["straight"].values()) == pytest.approx(straight, rel=1e-6)
    assert set(document["straight"]) == {name for name in document["terms"] if "_lost_" in name}
    found = [11.25 * value for term, value in document["terms"].items() if term.startswith("expected_error")]
    assert told[1].startswith(f"  expected error {found[0]:.2f} / {found[1]:.2f} mm with 0 / 1 fibres failed")
    assert told[2].split() == f"{11.25 * straight[0]:.2f} / {11.25 * straight[1]:.2f} mm with straight fibres".split()
    assert any("straight fibres: nothing better" in line or "no better than straight" in line for line in told[3:])


def test_straight_fibres_that_a_short_search_hands_back_are_called_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pad.toml").write_text(QUICK.replace("steps = 3", "steps = 1"))
    told = CliRunner().invoke(design, [], catch_exceptions=False).output.splitlines()
    assert json.loads(Path("out/pad/design.json").read_text())["found_by"] == "straight fibres"
    result = found_before(Path("out/pad"))
    assert result is not None
    assert result.found_by == "straight fibres"
    assert search_lines(result, Path("out/pad"))[1:] == told[1:]
    assert told[3:] == [
        "  these are straight fibres: nothing better was found; more steps or time may find it",
        "  all rules hold",
    ]
    searched = search_lines(replace(result, found_by="start 1"), Path("out/pad"))
    assert searched[3] == "  no better than straight fibres, as far as such figures tell, with 0, 1 failed"


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    """Of a pad of grid 2 and pitch 10 mm, pressed somewhat beyond its outer fibres."""
    path, gain = tmp_path_factory.mktemp("twin") / "twin.json", (0.1, 0.02, 0.9)
    channels = tuple(TwinChannel(channel, fibre, *gain) for channel, fibre in enumerate((2, 0, None)))
    reach = np.array([0.0, 2, 5, 8, 11, 15]), np.array([1, 0.95, 0.6, 0.25, 0.05, 0])
    laid = (np.array([[-15.0, -5], [15, -5]]), None, np.array([[-5.0, -15], [-5, 15]]), None)
    Twin(Morphology.straight(2, 10.0), channels, Frame(), *reach, laid, 0.03, (18.0, 31.5), 500).save(path)
    return path


QUICK_TWIN = QUICK.replace("[pad]\ngrid = 2\n", "")


def designed(*arguments, spec=QUICK_TWIN):
    """What `padforge design` ends with in this folder, and its design.json."""
    Path("pad.toml").write_text(spec)
    ended = CliRunner().invoke(design, [str(each) for each in arguments], catch_exceptions=False)
    return ended, json.loads(Path("out/pad/design.json").read_text())


def test_a_pad_is_designed_for_the_twin_of_a_printed_one(tmp_path, monkeypatch, twin):
    """Its reach, noise and sensed rectangle, as far as that lies on the pad, and its size: all but what is stated."""
    monkeypatch.chdir(tmp_path)
    ended, document = designed("--twin", twin)
    assert ended.exit_code in (0, 1)
    used = document["provenance"]["settings"]
    known = Twin.load(twin)
    assert Contact.model_validate_json(json.dumps(used["contact"])) == known.contact()
    scale = straight_full_scale(Morphology.straight(2, 10.0).layout, known.contact(), "beyond")
    assert used["search"]["noise"] == pytest.approx(0.02 / (0.1 * scale))
    assert (used["search"]["scatter"], used["search"]["scatter_common"]) == (0.0, 0.0)
    assert document["found_by"] in ("twin", "from usual", "usual", "straight fibres")
    assert (used["pad"]["grid"], used["pad"]["pitch_mm"], used["pad"]["sensed_mm"]) == (2, 10, [18, 30])
    assert document["provenance"]["inputs"] == {"twin.json": sha256(twin)}
    pad = Morphology.load("out/pad/morphology.json")
    asked = {"lost": 1, "size": PadSettings(sensed_mm=(18, 30)).of(pad.layout)}
    settings = SearchSettings(lost=1, noise=used["search"]["noise"], scatter=0.0, scatter_common=0.0)
    expected = error_terms(expected_errors(pad, known.contact(), settings, asked["size"]))
    assert document["terms"] == pytest.approx(score(pad, known.contact(), **asked) | expected, rel=1e-9)
    scored = CliRunner().invoke(design, ["score", "out/pad/morphology.json", "--twin", str(twin)])
    assert json.loads(scored.output)["terms"] == pytest.approx(document["terms"], rel=1e-9)
    wider = designed("--twin", twin, spec=QUICK_TWIN + "[pad]\npitch_mm = 20.0\n")[1]["provenance"]["settings"]
    assert wider["contact"]["reach"][-1] == [15, 0]
    assert (wider["pad"]["pitch_mm"], wider["pad"]["sensed_mm"]) == (20, [18, 31.5])


class KilledError(Exception):
    """Stands for a kill in mid-search."""


def test_a_search_for_a_twin_is_resumed(tmp_path, monkeypatch, twin):
    monkeypatch.chdir(tmp_path)
    long = QUICK_TWIN.replace("steps = 3", "steps = 60")
    whole = designed("--twin", twin, spec=long)[1]

    def killed(*step):
        raise KilledError

    spec = settings_for_twin(Spec.load(Path("pad.toml")), twin)
    pad, contact, settings = spec.section(PadSettings), spec.section(Contact), spec.section(SearchSettings)
    begun = state_folders(Path("out/pad/search"))["twin"]
    with pytest.raises(KilledError):
        search(pad, contact, settings, run=SearchRun(killed, begun))
    assert list(begun.glob("start_*.npz"))
    _, resumed = designed("--twin", twin, "--resume", spec=long)
    assert resumed["terms"] == whole["terms"]
    assert not list(Path("out/pad").glob("search*"))


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ("[contact]\nradius = 0.9\n", r"pad\.toml: \[contact\] is given beside .*twin\.json.*; leave one out"),
        ("[pad]\ngrid = 4\n", r"pad\.toml: \[pad\] asks for 4 \+ 4 fibres, .*, but .*twin\.json is of a pad of 2 \+ 2"),
        ("[pad]\ngrid = 0\n", r"grid"),
    ],
)
def test_settings_that_contradict_a_twin_are_refused(stated, said, tmp_path, monkeypatch, twin):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=said):
        designed("--twin", twin, spec=QUICK_TWIN + stated)


def test_defaults_that_are_written_out_contradict_no_twin(tmp_path, monkeypatch, twin):
    monkeypatch.chdir(tmp_path)
    stated = QUICK_TWIN + commented_toml({"contact": Contact})
    assert designed("--twin", twin, spec=stated)[1]["provenance"]["settings"]["search"]["scatter"] == 0.0


def test_what_is_no_twin_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for path in ("none.json", "pad.json"):
        Morphology.straight(2).save("pad.json")
        with pytest.raises(InputError, match=path):
            designed("--twin", path)


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


def test_rules_that_cannot_be_are_told_before_an_import_writes_anything(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Morphology.straight(2).save(tmp_path / "pad.json")
    (tmp_path / "pad.toml").write_text("[pad]\ngrid = 2\n")
    CliRunner().invoke(design, ["show", "pad.json", "--out", "plan.svg"], catch_exceptions=False)
    (tmp_path / "pad.toml").write_text("[pad]\ngrid = 2\n[rules]\nlost = 1\n")
    with pytest.raises(InputError, match=r"\[rules\] lost: no such key"):
        CliRunner().invoke(design, ["import", "plan.svg"], catch_exceptions=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["pad.json", "pad.toml", "plan.svg"]


@pytest.mark.parametrize(
    ("key", "value"),
    [("terms", {"ambiguity": {}}), ("straight", {"ambiguity": "a"}), ("violations", [{"rule": 1}]), ("terms", [])],
)
def test_what_a_search_has_found_is_read_again_or_told_to_be_damaged(tmp_path, monkeypatch, key, value):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pad.toml").write_text(QUICK)
    CliRunner().invoke(design, ["--out", "pad"], catch_exceptions=False)
    document = json.loads(Path("pad/design.json").read_text())
    found = found_before(tmp_path / "pad")
    assert found is not None
    assert (found.terms, found.straight) == (document["terms"], document["straight"])
    assert found.found_by == document["found_by"]
    Path("pad/design.json").write_text(json.dumps(document | {key: value}))
    with pytest.raises(InputError, match="not as padforge writes it"):
        found_before(tmp_path / "pad")
