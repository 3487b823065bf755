import zipfile

import numpy as np
import pytest
import trimesh

from design.errors import InputError
from design.morphology import Morphology
from fabricate.export import build
from fabricate.findings import Finding
from fabricate.outlines import Plan
from fabricate.printability import SOUND, check, check_mesh, inspect, inspect_mesh
from fabricate.settings import DEFAULTS, Printer, Settings

from .planted import level_pad, with_settings


def found(pad: Morphology, name: str, settings: Settings = DEFAULTS) -> Finding:
    return {finding.name: finding for finding in check(pad, settings)}[name]


def mesh_statuses(mesh: trimesh.Trimesh) -> dict[str, str]:
    return {f.name: f.status for f in inspect_mesh(mesh.vertices, mesh.faces, DEFAULTS.printer)}


def test_a_buildable_pad_passes_every_check():
    findings = check(Morphology.straight(4))
    assert {finding.status for finding in findings} == {"pass"}
    assert len({finding.name for finding in findings}) == len(findings)


def test_published_pad_that_was_built_shows_its_crossings(published):
    finding = found(Morphology.load(published / "5para_dis.mat"), "same_family_crossings")
    assert (finding.status, finding.measured, len(finding.places_mm)) == ("fail", 6, 6)


@pytest.mark.parametrize(("knots", "seed"), [(1, 1006), (5, 1001), (20, 1003), (30, 1032)])
def test_tangled_pads_are_measured_and_sound(knots, seed):
    findings = {finding.name: finding for finding in check(Morphology.random(4, knots, seed))}
    assert {findings[name].status for name in SOUND} == {"pass"}
    assert len(findings) == 14


class TestMesh:
    box = trimesh.creation.box((10, 20, 5))

    def test_a_box_passes(self):
        assert set(mesh_statuses(self.box).values()) == {"pass"}

    def test_a_missing_triangle(self):
        mesh = trimesh.Trimesh(self.box.vertices, self.box.faces[1:])
        findings = {f.name: f for f in inspect_mesh(mesh.vertices, mesh.faces, DEFAULTS.printer)}
        assert findings["manifold"].status == findings["watertight"].status == "fail"
        assert findings["watertight"].measured == len(findings["watertight"].places_mm) == 3

    def test_one_triangle_turned_round(self):
        faces = np.array(self.box.faces)
        faces[0] = faces[0][::-1]
        assert mesh_statuses(trimesh.Trimesh(self.box.vertices, faces))["watertight"] == "fail"

    def test_two_bodies(self):
        vertices = np.vstack([self.box.vertices, self.box.vertices + np.array([30, 0, 0])])
        mesh = trimesh.Trimesh(vertices, np.vstack([self.box.faces, self.box.faces + 8]))
        assert mesh_statuses(mesh)["bodies"] == "fail"

    def test_inside_out(self):
        mesh = self.box.copy()
        mesh.invert()
        assert mesh_statuses(mesh)["volume"] == "fail"

    def test_a_hole_through_the_mould(self):
        torus = trimesh.creation.torus(10, 2)
        findings = inspect(Plan(Morphology.straight(1)), torus.vertices, torus.faces)
        genus = next(finding for finding in findings if finding.name == "genus")
        assert (genus.status, genus.measured) == ("fail", 1)

    @pytest.mark.parametrize(
        ("bed", "status"),
        [
            ([10.0, 20.0, 5.0], "pass"),
            ([20.0, 10.0, 5.0], "pass"),
            ([19.0, 19.0, 5.0], "fail"),
            ([20.0, 20.0, 4.0], "fail"),
        ],
    )
    def test_bed(self, bed, status):
        findings = inspect_mesh(self.box.vertices, self.box.faces, Printer(bed_mm=bed))
        assert next(finding for finding in findings if finding.name == "bed").status == status

    @pytest.mark.parametrize("suffix", ["stl", "3mf"])
    def test_files(self, tmp_path, suffix):
        path = tmp_path / f"box.{suffix}"
        if suffix == "3mf":
            pytest.importorskip("lxml")
        self.box.export(path)
        assert {finding.status for finding in check_mesh(path)} == {"pass"}

    def test_files_that_hold_no_mesh(self, tmp_path):
        with pytest.raises(InputError, match="no such file"):
            check_mesh(tmp_path / "absent.stl")
        for name, content in (("torn.stl", b"\0" * 90), ("empty.stl", b""), ("torn.3mf", b"PK")):
            (tmp_path / name).write_bytes(content)
            with pytest.raises(InputError, match=name):
                check_mesh(tmp_path / name)


class TestPrinter:
    straight = Morphology.straight(1)

    @pytest.mark.parametrize(
        ("printer", "status", "limit"),
        [
            ({}, "pass", 0.4),
            ({"nozzle_mm": 0.6}, "fail", 0.6),
            ({"nozzle_mm": 0.05, "resin": True}, "pass", 0.1),
            ({"nozzle_mm": 0.25, "resin": True}, "fail", 0.5),
        ],
    )
    def test_ridge_width(self, printer, status, limit):
        finding = found(self.straight, "ridge_width", with_settings(printer=printer))
        assert (finding.status, finding.measured, finding.limit) == (status, 0.4, limit)

    @pytest.mark.parametrize(
        ("layer_mm", "status", "least"), [(0.1, "pass", 4), (0.2, "pass", 2), (0.16, "warn", 2.5), (0.3, "fail", 4 / 3)]
    )
    def test_layers(self, layer_mm, status, least):
        finding = found(self.straight, "layers", with_settings(printer={"layer_mm": layer_mm}))
        assert finding.status == status
        assert finding.measured == pytest.approx(least)

    def test_a_floor_between_layers_moves_every_ridge(self):
        finding = found(self.straight, "layers", with_settings({"floor_mm": 2.05}))
        assert finding.status == "warn"
        assert "floor_mm" in finding.message


class TestFibres:
    def test_a_fibre_thicker_than_its_track(self):
        finding = found(Morphology.straight(1), "track_size", with_settings(pad={"fibre_diameter_mm": 0.5}))
        assert (finding.status, finding.measured, finding.limit) == ("fail", 0.4, 0.5)

    @pytest.mark.parametrize(("deep", "status", "gap"), [(1.2, "pass", 0.5), (0.9, "warn", 0.2), (0.7, "fail", 0.0)])
    def test_gap_where_families_cross(self, deep, status, gap):
        finding = found(Morphology.straight(1), "crossing_gap", with_settings({"deep_ridge_height_mm": deep}))
        assert finding.status == status
        assert finding.measured == pytest.approx(gap, abs=1e-12)

    @pytest.mark.parametrize(("allowed", "status"), [(0, "fail"), (1, "fail"), (2, "warn")])
    def test_crossings_of_one_family(self, allowed, status):
        settings = with_settings(rules={"same_family_crossings": allowed})
        finding = found(level_pad(1.8, 1.2), "same_family_crossings", settings)
        assert (finding.status, finding.measured) == (status, 2)
        (left, y), (right, _) = finding.places_mm
        assert left == pytest.approx(-right, abs=1e-3)
        assert y == pytest.approx(0, abs=1e-3)


class TestSilicone:
    @pytest.mark.parametrize(("gap_mm", "status"), [(2.0, "pass"), (0.45, "pass"), (0.35, "warn"), (0.1, "warn")])
    def test_wall_between_two_tracks(self, gap_mm, status):
        away = (gap_mm + 0.4) / 20
        finding = found(level_pad(1.5 - away, 1.5 + away), "silicone_wall_horizontal")
        assert finding.status == status
        assert finding.measured == pytest.approx(gap_mm, abs=max(0.015, 0.02 * gap_mm))
        assert all(abs(y) < gap_mm for _, y in finding.places_mm)
        assert bool(finding.places_mm) == (status != "pass")

    def test_the_other_family_is_not_blamed(self):
        assert found(level_pad(1.47, 1.53), "silicone_wall_vertical").status == "pass"

    def test_a_fibre_that_turns_back_on_itself(self):
        turns = np.array([[0, 1], [0.95, 1], [0.98, 1.8], [1.04, 0.2], [1.07, 1], [2, 1]])
        pad = Morphology(np.stack([turns, np.stack([np.ones(6), np.linspace(0, 2, 6)], axis=1)]), 11.25)
        assert found(pad, "silicone_wall_horizontal").status != "pass"

    @pytest.mark.parametrize(("from_wall_mm", "status"), [(0.7, "pass"), (0.4, "warn"), (0.1, "fail")])
    def test_a_track_beside_the_tray_wall(self, from_wall_mm, status):
        finding = found(level_pad(from_wall_mm / 10, 2.0), "tray_wall")
        assert finding.status == status
        assert finding.measured == pytest.approx(from_wall_mm - 0.2, abs=0.01)
        assert all(y == pytest.approx(-15 + from_wall_mm, abs=0.01) for _, y in finding.places_mm)

    def test_a_border_keeps_tracks_off_the_wall(self):
        finding = found(level_pad(0.01, 2.0), "tray_wall", with_settings({"border_mm": 2.0}))
        assert (finding.status, finding.places_mm) == ("pass", ())


def test_findings_are_plain_json():
    document = found(level_pad(1.8, 1.2), "same_family_crossings").document()
    assert list(document) == ["name", "status", "measured", "limit", "message", "places_mm"]
    assert all(isinstance(value, float) for place in document["places_mm"] for value in place)


def test_a_3mf_in_inches_is_as_large_as_it_says(tmp_path):
    build(Morphology.straight(2), tmp_path, ["3mf"])
    with zipfile.ZipFile(tmp_path / "mould.3mf") as source, zipfile.ZipFile(tmp_path / "inch.3mf", "w") as target:
        for name in source.namelist():
            target.writestr(name, source.read(name).replace(b"millimeter", b"inch"))
    beds = [{f.name: f for f in check_mesh(tmp_path / name)}["bed"] for name in ("mould.3mf", "inch.3mf")]
    assert [bed.status for bed in beds] == ["pass", "fail"]


@pytest.mark.parametrize("content", [b"", b"solid\n", b"\0" * 84, b"\xff" * 500])
def test_a_torn_mesh_is_refused_on_one_line(tmp_path, content):
    path = tmp_path / "torn.stl"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"torn\.stl") as refusal:
        check_mesh(path)
    assert "\n" not in str(refusal.value)
