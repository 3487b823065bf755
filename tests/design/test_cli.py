"""Commands of design: where their results go, pads designed for a twin, and plans as pictures."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.patches import Circle, Polygon

from padforge import InputError, Spec
from padforge.common.files import sha256
from padforge.common.plotting import HORIZONTAL, VERTICAL
from padforge.common.settings import commented_toml
from padforge.design import Contact, Morphology, SearchOptions, Twin, draw_plan, score, search
from padforge.design.cli import design
from padforge.design.contact import half_width_mm
from padforge.design.design_run import load_result, summary_lines
from padforge.design.objectives.ambiguity import AMBIGUITY_NOISE, ambiguities
from padforge.design.objectives.bayes_error import expected_errors
from padforge.design.objectives.expected_error import straight_full_scale
from padforge.design.objectives.rules import Violation
from padforge.design.optimize.search import SearchResult, settings_for_twin, state_folders
from padforge.design.paths.curves import crossings, lengths
from padforge.design.settings import Layout, PadSettings, Scatter, SearchSettings
from padforge.design.twin import PlanTransform, TwinChannel, TwinScatter
from tests.helpers.less import compare_little

QUICK_SEARCH = "[search]\nknots = 2\nstarts = 1\nsteps = 3\nmax_failures = 1\n"
QUICK = "[pad]\ngrid = 2\n" + QUICK_SEARCH.replace("steps = 3", "steps = 1")


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def designed(*arguments, spec):
    """What `padforge design` says in this folder, and its design.json."""
    Path("pad.toml").write_text(spec)
    ended = CliRunner().invoke(design, [str(each) for each in arguments], catch_exceptions=False)
    assert ended.exit_code in (0, 1)
    return ended.output.splitlines(), json.loads(Path("out/pad/design.json").read_text())


def test_design_summary_compares_with_straight_fibres_and_is_loaded_again(here):
    printed, document = designed(spec=QUICK)
    pad, options = Morphology.straight(2), {"max_failures": 1, "size": PadSettings(grid=2)}
    straight = [
        *expected_errors(pad, Contact(), SearchSettings(max_failures=1), options["size"]),
        *ambiguities(pad, Contact(), noise=AMBIGUITY_NOISE, **options),
    ]
    straight_mm = [pad.unit_mm * value for value in straight]
    assert list(document["straight"].values()) == pytest.approx(straight_mm, rel=1e-3)  # other elements
    assert set(document["straight"]) == {name for name in document["terms"] if "_mm_" in name}
    result = load_result(Path("out/pad"))
    assert result is not None
    assert (result.terms, result.straight) == (document["terms"], document["straight"])
    assert document["descriptions"].keys() == document["terms"].keys()
    assert document["candidate"] == result.candidate
    assert summary_lines(result, Path("out/pad"))[1:] == printed[1:]
    first, second = (document["terms"][f"expected_error_mm_{failed}"] for failed in range(2))
    assert printed[1].startswith(f"  expected error  {first:.2f} / {second:.2f} mm with 0 / 1 failed fibres")
    pads = result.morphology, pad
    counts = [f"{lengths(p).sum() * p.unit_mm / 1000:.2f} m, {len(crossings(p))} crossings" for p in pads]
    assert printed[-2:] == [f"  fibre           {counts[0]}; straight fibres {counts[1]}", "  all rules hold"]
    for candidate, said in (
        ("straight fibres", "the search found no better pad"),
        ("start 1", "not significantly better"),
    ):
        lines = summary_lines(replace(result, candidate=candidate), Path("out/pad"))
        assert lines[3].startswith(f"  {said}")
    wrong = {"terms": {"ambiguity": {}}}, {"terms": []}, {"straight": {"ambiguity": "a"}}, {"violations": [{"rule": 1}]}
    for change in wrong:
        Path("out/pad/design.json").write_text(json.dumps(document | change))
        with pytest.raises(InputError, match="not as padforge writes it"):
            load_result(Path("out/pad"))


def test_design_summary_counts_the_rules_that_it_does_not_list():
    broken = [Violation("max_length_mm", (fibre,), 600.0, 500.0) for fibre in range(1, 31)]
    errors = {"expected_error_mm_0": 0.5}
    result = SearchResult(Morphology.straight(15), errors, broken, "start 1", {"expected_error_mm_0": 1.0})
    lines = summary_lines(result, Path("out/pad"))
    listed = [line for line in lines if line.startswith("  broken: ")]
    assert listed == [f"  broken: {violation}" for violation in broken[: len(listed)]]
    assert lines[-1] == f"  ... and {30 - len(listed)} more"
    assert len(summary_lines(replace(result, violations=broken[: len(listed)]), Path("out/pad"))) == len(lines) - 1


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    """Of a pad of grid 2 and pitch 10 mm, pressed somewhat beyond its outer fibres."""
    path = tmp_path_factory.mktemp("twin") / "twin.json"
    gains = enumerate(((2, -0.1), (0, -0.1), (1, 0.4)))
    channels = tuple(TwinChannel(channel, fibre, gain, abs(gain) / 5, 0.9) for channel, (fibre, gain) in gains)
    reach = np.array([0.0, 2, 5, 8, 11, 15]), np.array([1, 0.95, 0.6, 0.25, 0.05, 0])
    line = np.array([[-15.0, -5], [15, -5]])
    laid = (line, line, line[:, ::-1], None)
    known = PlanTransform(), *reach, laid, 0.03, (18.0, 31.5), 500
    Twin(Morphology.straight(2, 10.0), channels, *known, scatter=TwinScatter(0.05, 0.5, 0.8)).save(path)
    return path


def test_settings_for_twin_take_profile_noise_area_and_layout(here, twin):
    """Of the rectangle what lies on the pad; the defaults of a contact that are written out contradict none."""
    Path("pad.toml").write_text(QUICK_SEARCH + commented_toml({"contact": Contact}))
    spec, contact = settings_for_twin(Spec.load(Path("pad.toml")), twin), Twin.load(twin).contact()
    assert spec.section(Contact) == contact
    used, pad = spec.section(SearchSettings), spec.section(PadSettings)
    scale = straight_full_scale(Morphology.straight(2, 10.0).layout, contact, "beyond")
    assert (used.noise, used.scatter, used.scatter_common) == (pytest.approx(0.8 * 0.02 / (0.1 * scale)), 0.05, 0.5)
    assert (used.knots, pad.grid, pad.pitch_mm, pad.sensed_mm) == (2, 2, 10, (18, 30))
    wider = settings_for_twin(Spec({"pad": {"pitch_mm": 20.0}}), twin)
    assert wider.section(Contact).sensitivity_profile[-1] == (15, 0)
    assert (wider.section(PadSettings).pitch_mm, wider.section(PadSettings).sensed_mm) == (20, (18, 31.5))
    sized = settings_for_twin(Spec({"pad": {"size_mm": [36.0, 45.0]}}), twin)
    assert sized.section(PadSettings).layout == Layout(2, 2, 12.0, 15.0)
    Morphology.straight(2, 10.0).save(here / "pad.json")
    scored = CliRunner().invoke(design, ["score", "pad.json", "--twin", str(twin)], catch_exceptions=False)
    terms = evaluate(Morphology.straight(2, 10.0), contact, used.noise)
    assert json.loads(scored.output)["terms"] == pytest.approx(terms, rel=1e-9)


def evaluate(pad, contact, noise):
    """What a pad scores and errs for the contact and noise of the twin."""
    options = {"max_failures": 1, "size": PadSettings(sensed_mm=(18, 30)).for_layout(pad.layout)}
    return score(pad, contact, **options, scatter=Scatter(noise, 0.05, 0.5))


@pytest.mark.slow
def test_design_for_twin_uses_its_contact(here, twin, monkeypatch):
    compare_little(monkeypatch)
    _, document = designed("--twin", twin, spec=QUICK_SEARCH)
    used, contact = document["provenance"]["settings"], Twin.load(twin).contact()
    assert Contact.model_validate_json(json.dumps(used["contact"])) == contact
    assert document["candidate"] in ("twin", "from default", "default", "straight fibres")
    assert document["provenance"]["inputs"] == {"twin.json": sha256(twin)}
    pad = Morphology.load("out/pad/morphology.json")
    terms = evaluate(pad, contact, used["search"]["noise"])
    terms = {name: term for name, term in terms.items() if not name.startswith("published_")}  # those are of a shape
    assert document["terms"] == pytest.approx(terms, rel=1e-9)


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ("[contact]\nradius = 0.9\n", r"pad\.toml: \[contact\] is given beside .*twin\.json.*; leave one out"),
        ("[pad]\ngrid = 4\n", r"pad\.toml: \[pad\] asks for 4 \+ 4 fibres, .*, but .*twin\.json is of a pad of 2 \+ 2"),
        ("", "none.json"),
    ],
)
def test_design_for_twin_refuses_contradicting_settings_and_invalid_files(here, twin, stated, message):
    with pytest.raises(InputError, match=message):
        designed("--twin", twin if stated else message, spec=QUICK_SEARCH + stated)


@pytest.mark.slow
def test_search_for_twin_resumes(here, twin, monkeypatch):
    compare_little(monkeypatch)
    long = QUICK_SEARCH.replace("steps = 3", "steps = 8")
    _, unbroken = designed("--twin", twin, spec=long)

    def stop(*step):
        raise SystemError

    spec = settings_for_twin(Spec.load(Path("pad.toml")), twin)
    pad, contact, settings = spec.section(PadSettings), spec.section(Contact), spec.section(SearchSettings)
    states = state_folders(Path("out/pad/search"))["twin"]
    with pytest.raises(SystemError):
        search(pad, contact, settings, run=SearchOptions(stop, states))
    assert list(states.glob("start_*.npz"))
    _, resumed = designed("--twin", twin, "--resume", spec=long)
    assert resumed["terms"] == unbroken["terms"]
    assert not list(Path("out/pad").glob("search*"))


def test_show_writes_plan_to_folder_of_pad_or_out(here):
    Morphology.straight(2).save(here / "pad" / "morphology.json")
    shown = CliRunner().invoke(design, ["show", "pad/morphology.json"], catch_exceptions=False)
    assert shown.output == "plan -> pad/plan.svg\n"
    assert Path("pad/plan.svg").exists()
    with pytest.raises(InputError, match=r"--out is a\.pdf, allowed are \.svg and \.png"):
        CliRunner().invoke(design, ["show", "pad/morphology.json", "--out", "a.pdf"], catch_exceptions=False)


def test_import_refuses_invalid_rules_before_writing(here):
    Path("plan.svg").touch()
    Path("pad.toml").write_text("[rules]\nlost = 1\n")
    with pytest.raises(InputError, match=r"\[rules\] lost: no such key"):
        CliRunner().invoke(design, ["import", "plan.svg"], catch_exceptions=False)
    assert sorted(path.name for path in here.iterdir()) == ["pad.toml", "plan.svg"]


def test_check_applies_keep_outs_of_settings(here):
    Morphology.straight(2).save(here / "pad.json")
    for settings, code in (("", 0), ("keep_out_mm = [[[-9, 3], [-3, 3], [-3, 8], [-9, 8]]]\n", 1)):
        (here / "pad.toml").write_text(f"[pad]\ngrid = 2\n{settings}")
        assert CliRunner().invoke(design, ["check", "pad.json"]).exit_code == code


def test_plan_draws_keep_outs_and_half_width_of_contact():
    holes = [((-3.0, 1.0), (2.0, 1.0), (0.0, 4.0)), [[5, 5], [6, 5], [6, 6], [5, 6]]]
    for contact, radius_mm in (
        (Contact(), half_width_mm(Contact())),
        (Contact(model="profile"), np.sqrt(2 * np.log(2)) * 6.2),
    ):
        patches = draw_plan(Morphology.straight(2, (20.0, 8.0)), contact, (), holes).axes[0].patches
        drawn = [patch.get_xy()[:-1].tolist() for patch in patches if isinstance(patch, Polygon)]
        assert drawn == [np.array(hole).tolist() for hole in holes]
        (press,) = (patch for patch in patches if isinstance(patch, Circle))
        assert press.radius == pytest.approx(radius_mm, rel=0.01)


def test_plan_is_drawn_in_mm_with_numbers_crossings_and_broken_rules():
    knots = np.array([[[0, 1], [1, 2.2], [2, 0.8], [3, 1]], [[0, 2], [1, 1], [2, 2.2], [3, 2]]])
    pad = Morphology(np.concatenate([knots, knots[:, :, ::-1]]), 10.0)
    violations = [Violation("min_gap_mm", (1, 2), 1.0, 2.0, (3.0, -4.0))]
    axes: Any
    [axes] = draw_plan(pad, Contact(), violations).axes
    lines = {line.get_gid(): line for line in axes.lines}
    assert list(lines) == ["horizontal-1", "horizontal-2", "vertical-1", "vertical-2"]
    assert [line.get_color() for line in lines.values()] == [HORIZONTAL] * 2 + [VERTICAL] * 2
    for fibre, line in enumerate(lines.values()):
        np.testing.assert_allclose(line.get_xydata()[[0, -1]], pad.to_mm(pad.knots[fibre, [0, -1]]))
        number = axes.texts[fibre]
        family = pad.layout.family(fibre)
        assert (number.get_text(), number.get_position()[family]) == (str(fibre + 1), pytest.approx(15.3))
    dots, rings, crosses = axes.collections
    same = [c for c in crossings(pad) if pad.layout.family(c.first) == pad.layout.family(c.second)]
    np.testing.assert_allclose(rings.get_offsets(), [pad.to_mm(c.position) for c in same])
    assert len(dots.get_offsets()) == len(crossings(pad)) - len(same)
    assert crosses.get_offsets().tolist() == [[3, -4]]
    title = f"2 + 2 fibres, pitch 10 mm, {len(crossings(pad))} crossings, {len(same)} within a family, 1 rules broken"
    assert axes.get_title() == title
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (mm)", "y (mm)")
    assert (axes.get_xlim(), axes.get_ylim()) == ((-16.2, 16.2), (-16.2, 16.2))
