"""Arms and boards, found by entry points."""

from importlib.metadata import EntryPoint, EntryPoints

import pytest

from design.common.errors import InputError
from sense.rig.arms.ur5.driver import UR5
from sense.rig.devices import plugins
from sense.rig.devices.plugins import device, device_names
from sense.settings import RigSettings


def test_what_padforge_has_is_found_by_name() -> None:
    assert "ur5" in device_names("padforge.arms")
    assert "due" in device_names("padforge.boards")
    assert isinstance(device("padforge.arms", "ur5")(RigSettings()), UR5)


def test_an_unknown_name_is_told_with_those_there_are() -> None:
    with pytest.raises(InputError, match=r"^arms: got 'crane', allowed are .*ur5"):
        device("padforge.arms", "crane")


def test_a_package_that_cannot_be_imported_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = EntryPoints([EntryPoint("crane", "no.such.module:Crane", "padforge.arms")])
    monkeypatch.setattr(plugins, "entry_points", lambda group: broken)
    with pytest.raises(InputError, match=r"^crane: no.such.module:Crane cannot be loaded"):
        device("padforge.arms", "crane")
