from pathlib import Path

import pytest

from design import Contact, InputError, Morphology, PadSettings, SearchSettings
from design.optimisers.search import SearchResult
from sense.studies.pads import described, load_pads


def test_pads_are_told_by_file_or_by_name(tmp_path: Path) -> None:
    winding = Morphology.random(2, 3, 0)
    (tmp_path / "mine").mkdir()
    path = tmp_path / "mine" / "morphology.json"
    winding.save(path)
    pads = load_pads(("square@3", "random-2@2", str(path)), seed=4)
    assert pads == {
        "square@3": Morphology.straight(3),
        "random-2@2": Morphology.random(2, 2, 4),
        "mine": winding,
    }


def test_pads_are_searched_for_with_so_many_knots_by_either_method(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def remembered(pad: PadSettings, contact: Contact, settings: SearchSettings) -> SearchResult:
        asked.append((pad.grid, settings.method, settings.knots, settings.seed))
        return SearchResult(Morphology.straight(pad.grid), {}, [], "start 1", {})

    monkeypatch.setattr("design.optimisers.search.search", remembered)
    names = ("optimised", "optimised-5", "genetic-1@2", "optimised-30@3")
    assert tuple(load_pads(names, seed=4)) == names
    assert asked == [(4, "descent", 21, 4), (4, "descent", 5, 4), (2, "genetic", 1, 4), (3, "descent", 30, 4)]
    with pytest.raises(InputError, match="genetic search knots: got 65"):
        load_pads(("genetic-65",), seed=0)
    for name in ("genetic", "optimised-0", "square-5"):
        with pytest.raises(InputError, match="none of square, optimised, random-N, optimised-N, genetic-N"):
            load_pads((name,), seed=0)


def test_what_is_said_of_a_square_pad_has_its_grid_and_of_another_one_its_fibres() -> None:
    told = described({"square": Morphology.straight(2), "wide": Morphology.straight((1, 3), (8.0, 15.0))})
    assert (told["square"]["grid"], told["square"]["pitch_mm"]) == (2, 11.25)
    assert (told["wide"]["fibres"], told["wide"]["pitch_mm"]) == ([1, 3], (8.0, 15.0))


def test_no_label_is_a_formula_of_a_spreadsheet(tmp_path: Path) -> None:
    for name in ("=1+1", "@mine", "-_+x"):
        Morphology.straight(2).save(tmp_path / f"{name}.json")
    assert list(load_pads([str(path) for path in sorted(tmp_path.iterdir())], seed=0)) == ["x", "1+1", "mine"]
