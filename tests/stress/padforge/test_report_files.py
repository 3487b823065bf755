"""Reports on files of design and fabricate that were changed: written, or refused in one line."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from design.common.errors import InputError
from padforge import write_report
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.damage import damages, dump, replacements
from tests.stress.door import require_one_line


@few(60)
@given(st.sampled_from(["design.json", "fabrication.json"]), replacements(), damages(), st.integers(0, 4))
def test_reports_on_changed_files(
    folder: Path, name: str, replace: Callable[[Any], Any], damage: Callable[[bytes], bytes], how: int
):
    target = folder / ("mould.stl" if how == 0 else "mould.png" if how == 1 else name)
    before = target.read_bytes()
    try:
        if how < 3:
            target.write_bytes(damage(before))
        else:
            dump(target, replace(json.loads(before)))
        (folder / "report.html").unlink(missing_ok=True)
        with ends_in_time():
            try:
                assert write_report(folder).read_text().endswith("</body>\n</html>\n")
            except InputError as error:
                require_one_line(error)
                assert not (folder / "report.html").exists()
    finally:
        target.write_bytes(before)
