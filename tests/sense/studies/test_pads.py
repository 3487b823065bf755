from pathlib import Path

from design import Morphology
from sense.studies.pads import load_pads


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
