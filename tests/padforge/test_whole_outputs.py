import json
from pathlib import Path

import pytest

from padforge.cli import cli
from padforge.common import profiling
from padforge.design import Contact, Morphology
from padforge.design.contact import contact_press, fibre_strains, half_width_mm
from tests.docs.test_commands import every
from tests.helpers.door import called
from tests.helpers.golden import json_text


@pytest.mark.parametrize("word", cli.commands)
def test_helps(word: str, tmp_path: Path, golden, monkeypatch: pytest.MonkeyPatch) -> None:
    """Click keeps the names of a help option as they are when it is first asked for, so they are left out."""
    monkeypatch.setenv("COLUMNS", "100")
    names = (name for name, _ in every(cli.commands[word], word))
    texts = [called(*name.split(), "--help", cwd=tmp_path).out for name in names]
    golden(f"padforge/help/{word}.txt", "\n\n".join(texts), forget=[r"(?:-h, )?--help +(?=Show)"])


def test_help_of_padforge_itself(tmp_path: Path, golden) -> None:
    """Also if nothing is asked of it."""
    golden("padforge/help/padforge.txt", called("--help", cwd=tmp_path).out)
    ended = called(cwd=tmp_path)
    assert (ended.code, ended.out, ended.err) == (2, "", called("-h", cwd=tmp_path).out)


def test_comparison_of_two_pads(tmp_path: Path, golden, figures, brief: None) -> None:
    Morphology.straight((2, 3), (8.0, 15.0)).save(tmp_path / "plain.json")
    Morphology.random(2, 3, seed=1).save(tmp_path / "bent.json")
    words = ("design", "compare", "plain.json", "bent.json", "--out", "both")
    ended = called(*words, cwd=tmp_path)
    golden("padforge/compared.txt", f"exit code {ended.code}\n{ended.err}{ended.out}")
    document = json.loads((tmp_path / "both" / "comparison.json").read_text())
    golden("padforge/comparison.json", json_text(document), forget=[r'(?<="versions": )\{[^}]*\}'])
    [compared] = [figure for figure in figures if len(figure.axes) == 2 and "failed" in figure.axes[0].get_xlabel()]
    golden("padforge/comparison.figure.txt", compared)
    plain, bent = document["rows"]
    assert plain["length_mm"] == pytest.approx(2 * 4 * 8 + 3 * 3 * 15)
    assert plain["errors_mm"] == plain["straight_mm"] != bent["errors_mm"]
    assert all(other["errors_mm"] == other["straight_mm"] for other in plain["others"].values())
    assert plain["force_n"] == pytest.approx(contact_press(Contact()).force_n(), rel=1e-9)  # Ecoflex 00-20
    assert plain["strain_percent"] == pytest.approx(100 * max(s for _, s in fibre_strains(Contact())))
    assert plain["half_width_mm"] == pytest.approx(half_width_mm(Contact()))
    mould = json.loads((tmp_path / "both" / "plain" / "fabrication.json").read_text())
    assert (plain["mould_ml"], plain["silicone_ml"]) == (mould["mould_volume_ml"], mould["silicone_volume_ml"])


def test_profile(golden, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(profiling.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(profiling, "HEAVY", ("json", "absent"))
    with profiling.profiled() as profile:
        now[0] += 1
        for name, seconds in (("checks", 2), ("search", 20), ("checks", 8)):
            with profiling.stage(name):
                now[0] += seconds
        for name, evaluated, total in (("few", 1, 10), ("few", 2, 10), ("many", 250, 1000)):
            profiling.add_count(name, evaluated, total)
    golden("padforge/profile.txt", "\n".join(profile.lines()))
