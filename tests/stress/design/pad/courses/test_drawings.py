"""Drawings, damaged: curves that a pad is made of, or refused in one line."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from design import Contact, Morphology, draw_plan
from design.common.errors import InputError
from design.common.figures import save_figure
from design.pad.courses.drawings.plan import import_plan
from fabricate import Plan
from fabricate.report.track_drawings import tracks_dxf
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.damage import damages
from tests.stress.door import require_one_line

PAD = Morphology.random(1, 2, seed=0)
KINDS = ("plan.svg", "plan.dxf")


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder: Path = tmp_path_factory.mktemp("drawn")
    save_figure(draw_plan(PAD, Contact()), folder / KINDS[0])
    (folder / KINDS[1]).write_text(tracks_dxf(Plan(PAD)), encoding="utf-8")
    return {name: (folder / name).read_bytes() for name in KINDS}


@pytest.mark.parametrize("content", [b"", b"  0\nSECTION\n", b"  0\nSECTION\n  2\nHEADER\n"])
def test_a_drawing_that_has_only_begun_is_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "plan.dxf").write_bytes(content)
    with pytest.raises(InputError, match="not a DXF file that can be read"):
        import_plan(tmp_path / "plan.dxf", PAD.layout, 0.5)


def test_what_another_file_would_have_to_declare_draws_nothing(tmp_path: Path) -> None:
    head = '<!DOCTYPE svg SYSTEM "svg11.dtd"><svg xmlns="http://www.w3.org/2000/svg" viewBox="-15 -15 30 30"'
    ways = '&a;<path d="M -11 0 H 11"/><g>&b;<path d="M 0 -11 V 11"/>&c;</g>'
    (tmp_path / "plan.svg").write_text(f'{head} width="30mm" height="30mm">{ways}</svg>', encoding="utf-8")
    assert len(import_plan(tmp_path / "plan.svg", PAD.layout, 0.5).fibres) == 2


@few(60)
@given(name=st.sampled_from(KINDS), damage=damages())
def test_a_damaged_drawing_is_a_pad_or_one_line(
    drawn: dict[str, bytes],
    tmp_path_factory: pytest.TempPathFactory,
    name: str,
    damage: Callable[[bytes], bytes],
) -> None:
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes(damage(drawn[name]))
    with ends_in_time():
        try:
            found = import_plan(path, PAD.layout, 0.5)
        except InputError as error:
            require_one_line(error, name)
            return
    assert np.isfinite(found.pad.knots).all()
