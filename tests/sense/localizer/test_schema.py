"""A document with a value that no localizer has is refused in one line."""

import json
from pathlib import Path

import numpy as np
import pytest

from design.common.errors import InputError
from sense import Localizer


@pytest.mark.parametrize(("key", "value"), [("features", "smell"), ("scaling", {}), ("rate_hz", None)])
def test_a_document_that_is_no_localizer_is_refused(
    localizer: Localizer, tmp_path: Path, key: str, value: object
) -> None:
    localizer.save(tmp_path)
    document = json.loads((tmp_path / "localizer.json").read_text())
    (tmp_path / "localizer.json").write_text(json.dumps(document | {key: value}))
    with pytest.raises(InputError, match=r"localizer\.json"):
        Localizer.load(tmp_path)


def edited(document: dict, path: str, value: object) -> dict:
    """`document` with the entry at `path`, keys and indices with dots between them, replaced."""
    *way, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    place = document
    for part in way:
        place = place[part]
    place[last] = value
    return document


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        ("features", "smell", "features"),
        ("features", "published", r"scaling\.centre_v"),
        ("fibres", 3, r"scaling\.centre_v"),
        ("fibres", 0, "fibres"),
        ("fibres", True, "fibres"),
        ("method", "guess", "method"),
        ("method", "published", "features"),
        ("factors", [], "factors"),
        ("factors.0", [1.0, 1.0], "factors"),
        ("factors.0.0", -1.0, "factors"),
        ("scaling.memory", [], r"scaling\.memory"),
        ("scaling.memory.0.0", [1.0], r"scaling\.memory"),
        ("scaling.memory.0.0.0", np.nan, "memory"),
        ("scaling.usual_v.0", [1.0], r"scaling\.usual_v"),
        *(("rate_hz", value, "rate_hz") for value in (0, -1.0, "13", np.nan, np.inf, 1e-300, None)),
        *(
            (f"scaling.{key}.0.0", value, key)
            for key in ("centre_v", "spread_v")
            for value in (np.nan, np.inf, 1e9, "1")
        ),
        ("scaling.spread_v.0.0", 0.0, "spread_v"),
        ("scaling.spread_v.0", [1.0], "spread_v"),
        ("scaling.centre_v", [], "centre_v"),
        *(("scaling.middle_mm", value, "middle_mm") for value in ([0.0], [0.0, np.nan], [1e9, 0.0], 3, None)),
        *(("scaling.span_mm", value, "span_mm") for value in (0.0, -1.0, np.nan, np.inf, 1e30, "9")),
        ("split", "alphabetical", "split"),
        *(("test", value, "test") for value in ([], [0.5], ["a"], [-1], [True], {}, [3, 3], [7])),
        ("errors", [{}], r"errors\.0\.lost"),
        ("errors", "none", "errors"),
        ("learnt_from", 7, "learnt_from"),
        ("provenance", [], "provenance"),
        ("more", 1, "more"),
    ],
)
def test_a_document_with_a_value_out_of_bounds_is_refused(
    localizer: Localizer, tmp_path: Path, path: str, value: object, named: str
) -> None:
    localizer.save(tmp_path)
    document = edited(json.loads((tmp_path / "localizer.json").read_text()), path, value)
    (tmp_path / "localizer.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=rf"localizer\.json: .*{named}") as caught:
        Localizer.load(tmp_path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        ("scaling.measures", [{"name": "force_n", "middle": 1.0, "span": 1.0}], "force_n of method masked"),
        ("scaling.measures.0.name", "width_mm", "measures"),
        ("scaling.measures.0.span", 0.0, "span"),
        ("scaling.measures.0.middle", np.nan, "middle"),
        ("scaling.measures", [], "factors have .5. values a row, expected 3"),
        ("factors.0", [1.0, 1.0, 1.0], "factors have .3, 5. values"),
    ],
)
def test_measures_that_cannot_be_are_refused(
    deep_localizer: Localizer, tmp_path: Path, path: str, value: object, named: str
) -> None:
    deep_localizer.save(tmp_path)
    document = json.loads((tmp_path / "localizer.json").read_text())
    (tmp_path / "localizer.json").write_text(json.dumps(edited(document, path, value)))
    with pytest.raises(InputError, match=named):
        Localizer.load(tmp_path)


def test_a_localizer_of_one_depth_says_nothing_of_measures(localizer: Localizer, tmp_path: Path) -> None:
    localizer.save(tmp_path)
    document = json.loads((tmp_path / "localizer.json").read_text())
    assert "measures" not in document["scaling"]
    assert not [key for row in document["errors"] for key in row if key.startswith(("depth", "force"))]
