import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from padforge import Spec
from padforge.common.files import sha256
from padforge.common.settings import commented_toml
from padforge.design import Contact, Morphology, SearchOptions, Twin, score, search
from padforge.design.cli import design
from padforge.design.objectives.criterion import straight_full_scale
from padforge.design.optimize.search import settings_for_twin, state_folders
from padforge.design.settings import Layout, PadSettings, Scatter, SearchSettings
from tests.helpers.less import blank_pictures

SEARCH = "[search]\nknots = 2\nstarts = 1\nsteps = 3\nmax_failures = 1\n"


def run(*arguments: object, spec: str) -> dict:
    """The design.json that `padforge design` writes in this folder."""
    Path("pad.toml").write_text(spec)
    ended = CliRunner().invoke(design, list(map(str, arguments)), catch_exceptions=False)
    assert ended.exit_code in (0, 1)
    return json.loads(Path("out/pad/design.json").read_text())


def test_settings_for_twin_take_profile_noise_area_and_layout(here, twin):
    """Of the rectangle what lies on the pad; the defaults of a contact that are written out contradict none."""
    Path("pad.toml").write_text(SEARCH + commented_toml({"contact": Contact}))
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


@pytest.mark.slow
def test_design_for_twin_uses_its_contact_and_resumes(here, twin, little_scored, monkeypatch):
    blank_pictures(monkeypatch)
    monkeypatch.setattr("padforge.design.optimize.gradient.REPAIR_STEPS", 20)
    unbroken = run("--twin", twin, spec=SEARCH)
    used, contact = unbroken["provenance"]["settings"], Twin.load(twin).contact()
    assert Contact.model_validate_json(json.dumps(used["contact"])) == contact
    assert unbroken["candidate"] in ("twin", "from default", "default", "straight fibres")
    assert unbroken["provenance"]["inputs"] == {"twin.json": sha256(twin)}
    pad, scatter = Morphology.load("out/pad/morphology.json"), Scatter(used["search"]["noise"], 0.05, 0.5)
    size = PadSettings(sensed_mm=(18, 30)).for_layout(pad.layout)
    terms = score(pad, contact, max_failures=1, pad_settings=size, scatter=scatter)
    terms = {name: term for name, term in terms.items() if not name.startswith("published_")}  # those are of a shape
    assert unbroken["terms"] == pytest.approx(terms, rel=1e-9)

    def stop(*step):
        raise SystemError

    spec = settings_for_twin(Spec.load(Path("pad.toml")), twin)
    pad_settings, settings = spec.section(PadSettings), spec.section(SearchSettings)
    states = state_folders(Path("out/pad/search"))["twin"]
    with pytest.raises(SystemError):
        search(pad_settings, contact, settings, run=SearchOptions(stop, states))
    assert list(states.glob("start_*.npz"))
    assert run("--twin", twin, "--resume", spec=SEARCH)["terms"] == unbroken["terms"]
    assert not list(Path("out/pad").glob("search*"))
