"""The front door: what it imports and hands out, the settings it writes, and how it refuses."""

import os
import subprocess
import sys
import sysconfig
from importlib import metadata
from pathlib import Path

import pytest

import padforge
from padforge import Spec, design, fabricate, sense
from padforge.design import Contact, PadSettings, RulesSettings, SearchSettings
from tests.helpers.door import called, refused


def loaded_by(*codes: str) -> list[set[str]]:
    """Names of the modules that are loaded after each of `codes`, one after the other in a process that begins anew."""
    steps = (f"try:\n  {code}\nexcept SystemExit: pass\nprint('\\n@', *sys.modules)" for code in codes)
    command = [sys.executable, "-c", "\n".join(("import sys", *steps))]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    return [set(line[1:].split()) for line in result.stdout.splitlines() if line.startswith("@")]


def test_package_help_and_stages_import_only_what_they_need(tmp_path: Path) -> None:
    """What one may load, none before it has loaded."""
    pad, build = "p = design.Morphology.straight(1)", f"build(p, {str(tmp_path)!r}, ['stl', 'svg'])"
    compare = "from padforge.design.contact_comparison import errors_by_contact"
    settings = "design.PadSettings(grid=1), design.SearchSettings(max_failures=0)"
    package, helped, stage, built, compared = loaded_by(
        "import padforge",
        "sys.argv = ['padforge', '--help']; from padforge.cli import main; main()",
        "import padforge.fabricate.cli",
        f"from padforge import build, design; {pad}; design.signals(p, [[1, 1]]); {build}",
        f"{compare}; errors_by_contact({{'': p}}, {{'': design.Contact()}}, {settings})",
    )
    assert not {name for name in package if name.startswith("padforge.")}
    assert not package & {"numpy", "click", "pydantic"}
    cad = {"torch", "build123d", "OCP", "matplotlib"}
    assert "padforge.cli" in helped
    assert not helped & (cad | {"numpy", "numba", "pydantic", "shapely"})
    assert "padforge.fabricate.cli" in stage
    assert not stage & (cad | {"trimesh", "manifold3d", "numpy", "pydantic"})
    assert built >= {"numba", "manifold3d"}
    assert not built & (cad - {"matplotlib"})
    assert "padforge.design.objectives.bayes_error" in compared
    assert "torch" not in compared


def test_bench_of_a_wheel_is_refused_in_one_line() -> None:
    """In a process of its own: what there is to bench is found when the command line is imported."""
    code = "import sys; sys.modules['padforge.benchmarks'] = None; from padforge.cli import main; main()"
    command = [sys.executable, "-c", code, "bench", "contact", "--out", "x"]
    result = subprocess.run(command, capture_output=True, text=True)
    assert (result.returncode, result.stdout, result.stderr.count("\n")) == (2, "", 1)
    assert "checkout" in result.stderr


def test_init_writes_settings_that_every_command_reads(tmp_path: Path) -> None:
    assert called("init", cwd=tmp_path).code == 0
    text = (tmp_path / "pad.toml").read_text()
    for section in ("pad", "contact", "search", "rules", "mould", "printer", "dispenser", "rig", "localizer"):
        assert f"[{section}]" in text
    assert "exists already" in refused("init", cwd=tmp_path)
    (tmp_path / "pad.toml").write_text(text.replace('steps = "contact"', "steps = 0"))
    assert "pad.toml: [search] steps: got 0" in refused("run", cwd=tmp_path)


def test_init_writes_published_preset(tmp_path: Path) -> None:
    """And says which presets there are, where one is asked for that is none."""
    assert called("init", "--preset", "published", cwd=tmp_path).code == 0
    spec = Spec.load(tmp_path / "pad.toml")
    assert spec.section(PadSettings) == PadSettings(sensed_mm="fibres")
    assert spec.section(Contact) == Contact(
        radius=0.6, sides=30, weight="uniform", length="manhattan", sensitivity_profile=()
    )
    assert spec.section(SearchSettings) == SearchSettings(noise=0.005, scatter=0.0)
    assert spec.section(RulesSettings) == RulesSettings(max_common_track_mm=None)
    assert called("init", "other.toml", "--preset", "mine", cwd=tmp_path).code == 2
    assert "published" in called("init", "--help", cwd=tmp_path).out


@pytest.mark.parametrize(
    ("settings", "words", "said"),
    [
        ("", "design check none.json", "none.json"),
        ("", "design --knots 0", "Invalid value for '--knots': got 0, input should be greater than or equal to 1"),
        ("[search]\nknots = 3\n", "design --starts -1 --knots 2", "'--starts': got -1, input should be greater"),
        ("", "fabricate pad.toml", "pad.toml: no morphology, allowed are a .json and a published .mat"),
        ("", "fabricate check pad.csv", "allowed are a mesh .stl or .3mf, a morphology .json or .mat"),
        ("", "report none", "none"),
        ("", "design --start-from wavy", "--start-from is wavy, allowed are random, straight and a .json or .mat"),
        ("", "run --formats stl,obj", "Invalid value for '--formats': got 'obj', allowed are stl, 3mf"),
        ("", "run --time-budget nan", "Invalid value for '--time-budget': got 'nan', expected a finite number"),
        ("", "run --time-budget 0", "--time-budget: got 0 s, expected more than"),
        ("[pad]\ngrid = 2\n", "design compare --vary pad.grid=2,0", "pad.toml with --vary: [pad] grid: got 0"),
        ("", "fabricate check m.json --picture a.jpg", "--picture is a.jpg, allowed is a name that ends in .png"),
        ('[localizer]\nmethod = "published"\n', "run --time-budget 9", "method: got published with --time-budget"),
        ("[pad]\npitch_mm = 0.3\n", "run", "ridge_width_mm"),
        ('[pad]\n"\\u001b]0;title\\u0007\\u009b2J\\u202eä" = 1\n', "run", r"[pad] \x1b]0;title\x07\x9b2J\u202eä: no"),
    ],
)
def test_mistakes_are_refused_in_one_line(tmp_path: Path, settings: str, words: str, said: str) -> None:
    """What would fail late, too: before anything is done."""
    (tmp_path / "pad.toml").write_text(settings)
    assert said in refused(*words.split(), cwd=tmp_path)


def test_only_the_genetic_search_needs_pymoo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is refused before anything is written, and the line names the extra."""

    def version_without_pymoo(name: str) -> str:
        if name == "pymoo":
            raise metadata.PackageNotFoundError(name)
        return metadata.version(name)

    monkeypatch.setattr("padforge.common.files.installed_version", version_without_pymoo)
    smallest = "[pad]\ngrid = 1\n[search]\nknots = 1\nstarts = 1\nsteps = 1\nmax_failures = 1\n"
    (tmp_path / "pad.toml").write_text(smallest)
    said = refused("design", "--method", "genetic", cwd=tmp_path)
    assert said == "padforge: this needs pymoo, which is not installed: pip install 'padforge[design]'\n"
    ended = called("design", cwd=tmp_path)
    assert ended.code in (0, 1), ended
    assert (tmp_path / "out" / "pad" / "morphology.json").is_file()


def test_package_exports_a_dozen_names_of_the_stages() -> None:
    names = [name for package in (design, fabricate, sense) for name in package.__all__]
    assert len(names) == len(set(names))
    exported = set(dir(padforge)) - {"design", "fabricate", "sense"}
    assert 10 <= len(exported) <= 16
    for name in exported - {"Fault", "InputError", "Spec"}:  # of all stages
        package = next(package for package in (design, fabricate, sense) if name in package.__all__)
        assert getattr(padforge, name) is getattr(package, name), name
    with pytest.raises(AttributeError, match="nothing"):
        padforge.nothing  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
    for name in ("padforge.nothing", "padforge.design.nothing"):
        with pytest.raises(ModuleNotFoundError, match="nothing"):
            __import__(name)


@pytest.mark.skipif("PADFORGE_WHEEL" not in os.environ, reason="a checkout may be tested, too")
def test_tests_run_on_the_installed_wheel() -> None:
    """In this process and in those that it starts; benches come from the checkout, as a wheel has none."""
    installed = Path(sysconfig.get_path("purelib")) / "padforge"
    modules = {name: module.__file__ for name, module in sys.modules.items() if name.split(".")[0] == "padforge"}
    assert len(modules) > 10
    for name, path in modules.items():
        assert path is None or name.startswith("padforge.benchmarks") or Path(path).is_relative_to(installed), name
    code = "import padforge.design.cli; print(padforge.design.cli.__file__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert Path(done.stdout.strip()).parent == installed / "design"


def test_stages_have_one_import_name(tmp_path: Path) -> None:
    """A checkout shows `design` beside a lab's own folder of that name only to who works in the checkout."""
    code = "import padforge.design.morphology as m, padforge; print(m.__name__, m.Morphology is padforge.Morphology)"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["padforge.design.morphology", "True"]
    assert not [finder for finder in sys.meta_path if type(finder).__module__.startswith("padforge")]
