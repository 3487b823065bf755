"""Figures and texts of an identification show what was identified."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from padforge.common.plotting import FAINT, HORIZONTAL, VERTICAL
from padforge.design.paths.curves import flatten
from padforge.sense.report import identification as report
from padforge.sense.report.identification import identification_sections, identify_into
from padforge.sense.twin.identification import Identification
from padforge.sense.twin.wiring import Wiring


@pytest.fixture
def write_identification(identification: Identification, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Return a function to its document, which is written, and its two figures, which are not."""

    def write(**changes: object) -> tuple[dict[str, Any], Any, Any]:
        drawn: list[Any] = []
        monkeypatch.setattr(report, "save_figure", lambda figure, path: drawn.append(figure))
        monkeypatch.setattr(report, "identify_pad", lambda *_: replace(identification, **changes))
        document = identify_into(Mock(mirrored=True), identification.pad, tmp_path)
        assert json.loads((tmp_path / "identification.json").read_text()) == json.loads(json.dumps(document))
        return document, *drawn

    return write


def test_responses_are_drawn_in_millivolts_on_one_scale_a_channel(
    identification: Identification, write_identification: Any
) -> None:
    _, figure, _ = write_identification()
    held_out, pad = identification.held_out, identification.fit.pad
    predicted = pad.predict(held_out.positions_mm)
    panels = np.array([axes for axes in figure.axes if axes.get_label() != "<colorbar>"]).reshape(-1, 3)
    assert len(panels) == len(identification.live) == 4
    for row, axes in enumerate(panels):
        measured_mv, predicted_mv = 1e3 * held_out.volts[:, row], 1e3 * predicted[:, row]
        drawn = [each.collections[0] for each in axes]
        for dots, values in zip(drawn, (measured_mv, predicted_mv, measured_mv - predicted_mv), strict=True):
            np.testing.assert_allclose(dots.get_array(), values)
            np.testing.assert_allclose(dots.get_offsets(), held_out.positions_mm)
        assert len({dots.get_clim() for dots in drawn}) == 1
        assert axes[0].get_ylabel() == f"channel {row + 1}, fibre {pad.fibres[row] + 1}\ny (mm)"


def test_plan_is_drawn_grey_under_the_fibres_as_built(
    identification: Identification, write_identification: Any
) -> None:
    _, _, figure = write_identification()
    plan, offsets = figure.axes
    pad, built = identification.pad, identification.fit.pad
    grey, coloured = ([line for line in plan.lines if (line.get_color() == FAINT) == is_plan] for is_plan in (1, 0))
    for line, points in zip(grey, flatten(pad, 1e-3), strict=True):
        np.testing.assert_allclose(line.get_xydata(), pad.to_mm(points))
    colours = [(HORIZONTAL, VERTICAL)[pad.layout.family(fibre)] for fibre in built.fibres]
    assert [line.get_color() for line in coloured] == colours
    for row, line in enumerate(coloured):
        np.testing.assert_allclose(line.get_xydata(), pad.to_mm(built.path(row)[0]))
    assert [text.get_text() for text in plan.texts] == [str(fibre + 1) for fibre in built.fibres]
    presses = plan.collections[0].get_offsets()
    np.testing.assert_allclose(presses, built.transform.to_plan(identification.training.positions_mm))
    for line, band, (offset, std, within) in zip(
        offsets.lines, offsets.collections, identification.lateral_offsets_mm(), strict=False
    ):
        x, y = line.get_data()
        assert (x[0], x[-1]) == (0, 100)
        np.testing.assert_allclose(y, np.where(within, offset, np.nan))
        low, high = band.get_datalim(offsets.transData).intervaly
        assert high - low == pytest.approx(np.ptp([(offset - std)[within], (offset + std)[within]]))


def test_offsets_are_to_the_left_of_a_fibre_as_it_runs(
    identification: Identification, write_identification: Any
) -> None:
    """A horizontal fibre runs along x: to its left is y. The mean over what was pressed is the document's."""
    document, *_ = write_identification()
    built = identification.fit.pad
    for row, (offset, std, within) in enumerate(identification.lateral_offsets_mm()):
        fibre = built.fibres[row]
        shift_mm = identification.pad.unit_mm * (built.path(row)[0] - built.plan.paths[fibre])
        tangent = built.plan.tangents[fibre]
        normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
        np.testing.assert_allclose(offset, (shift_mm * normal).sum(axis=1), atol=1e-12)
        entry = document["channels"][row]
        assert entry["lateral_offset_mm"] == pytest.approx(np.sqrt((offset[within] ** 2).mean()))
        assert entry["lateral_offset_std_mm"] == pytest.approx(std[within].mean())
        assert entry["explained_smooth"] == identification.explained_smooth[row]


def test_document_and_section_state_what_was_identified(
    identification: Identification, write_identification: Any
) -> None:
    swapped = Wiring(identification.fit.pad.transform, 0.5, (1, 0, 2, 3), 0.9)
    shares = {"explained": np.array([0.9, 0.8, 0.7, 0.6]), "explained_smooth": np.zeros(4), "explained_on_plan": 0.55}
    document, *_ = write_identification(alternatives=[swapped], noise=0.0123, **shares)
    assert (document["presses"], document["held_out"]) == (
        len(identification.training.positions_mm),
        len(identification.held_out.positions_mm),
    )
    assert (document["explained"], document["explained_on_plan"]) == (pytest.approx(0.75), 0.55)
    assert [row["alternative_fibres"] for row in document["channels"]] == [[1], [0], [], []]
    assert (document["n_alternatives"], document["contact"], document["rig_mirrored"]) == (1, None, True)
    twin = identification.twin
    assert document["sensitivity_profile"] == {
        "distance_mm": twin.distance_mm.tolist(),
        "weight": twin.weight.tolist(),
    }
    [section] = identification_sections(Path(), document)
    text = " ".join(section.body)
    assert section.title == "The pad as built"
    assert f"Identified from {document['presses']} presses: the pad lay turned over, as [rig] mirrored says" in text
    assert (
        f"The twin explains 75% of the responses to {document['held_out']} held-out presses, the plan as it is 55%;"
        " noise is 1.2% of full scale."
    ) in text
    assert "doubtful: 1 other pose or wiring explains the presses nearly as well" in text
    assert section.figures == [("75%", "of the responses explained by the twin")]
