import os
import subprocess
import sys
import sysconfig
from importlib import metadata
from pathlib import Path
from unittest.mock import Mock

import pytest

from padforge.cli import cli
from padforge.common import compilation
from tests.helpers.door import called, refused
from tests.padforge.conftest import SMALLEST


def loaded_by(*codes: str) -> list[set[str]]:
    """Names of the modules that are loaded after each of `codes`, one after the other in a process that begins anew."""
    steps = (f"try:\n  {code}\nexcept SystemExit: pass\nprint('\\n@', *sys.modules)" for code in codes)
    command = [sys.executable, "-c", "\n".join(("import sys", *steps))]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    return [set(line[1:].split()) for line in result.stdout.splitlines() if line.startswith("@")]


def test_package_help_and_stages_import_only_what_they_need(tmp_path: Path) -> None:
    """What one may load, none before it has loaded."""
    pad, build = "p = design.Morphology.straight(1)", f"build(p, {str(tmp_path)!r}, ['stl', 'svg'])"
    compare = "from padforge.design import contact_comparison, editor"
    settings = "design.PadSettings(grid=1), design.SearchSettings(max_failures=0)"
    (tmp_path / "pad.toml").write_text(SMALLEST)
    package, helped, stage, designed, built, compared = loaded_by(
        "import padforge",
        "sys.argv = ['padforge', '--help']; from padforge.cli import main; main()",
        "import padforge.fabricate.cli",
        f"import os; os.chdir({str(tmp_path)!r}); sys.argv = ['padforge', 'design', '--json']; main()",
        f"from padforge import build, design; {pad}; design.signals(p, [[1, 1]]); {build}",
        f"{compare}; contact_comparison.errors_by_contact({{'': p}}, {{'': design.Contact()}}, {settings})",
    )
    assert not {name for name in package if name.startswith("padforge.")}
    assert not package & {"numpy", "click", "pydantic"}
    cad = {"torch", "build123d", "OCP", "matplotlib"}
    assert "padforge.cli" in helped
    assert not helped & (cad | {"numpy", "numba", "pydantic", "shapely"})
    assert "padforge.fabricate.cli" in stage
    assert not stage & (cad | {"trimesh", "manifold3d", "numpy", "pydantic"})
    assert "numba" in designed
    assert not designed & {"build123d", "manifold3d", "pymoo", "h5py", "torch", "trimesh"}
    assert built >= {"numba", "manifold3d"}
    assert not built & (cad - {"matplotlib"} | {"ezdxf"})
    assert compared >= {"padforge.design.objectives.bayes_error", "padforge.design.editor"}
    assert "torch" not in compared


def test_bench_of_a_wheel_is_refused_in_one_line() -> None:
    """In a process of its own: what there is to bench is found when the command line is imported."""
    code = "import sys; sys.modules['padforge.benchmarks'] = None; from padforge.cli import main; main()"
    command = [sys.executable, "-c", code, "bench", "contact", "--out", "x"]
    result = subprocess.run(command, capture_output=True, text=True)
    assert (result.returncode, result.stdout, result.stderr.count("\n")) == (2, "", 1)
    assert "checkout" in result.stderr


WHOLE = [[-40, -40], [40, -40], [40, 40], [-40, 40]]  # a keep-out


@pytest.mark.parametrize(
    ("settings", "words", "said"),
    [
        ("", "init", "pad.toml: exists already"),
        ("", "init other.toml --preset mine", "'mine' is not one of 'published'"),
        ("[search]\nsteps = 0\n", "run", "pad.toml: [search] steps: got 0"),
        ("", "design check none.json", "none.json"),
        ("[search]\nknots = 3\n", "design --starts -1 --knots 2", "'--starts': got -1, input should be greater"),
        ("", "fabricate pad.toml", "pad.toml: no morphology, allowed are a .json and a published .mat"),
        ("", "fabricate check pad.csv", "allowed are a mesh .stl or .3mf, a morphology .json or .mat"),
        ("", "report none", "none"),
        ("", "report .", ".: no design.json, fabrication.json, calibration.json or study to report on"),
        ("", "design --start-from wavy", "--start-from is wavy, allowed are random, straight and a .json or .mat"),
        ("", "run --formats stl,obj", "Invalid value for '--formats': got 'obj', allowed are stl, 3mf"),
        ("", "run --time-budget nan", "Invalid value for '--time-budget': got 'nan', expected a finite number"),
        ("", "run --time-budget 0", "--time-budget: got 0 s, expected more than"),
        ("", "design compare --vary grid=3", "SECTION.KEY=VALUE"),
        ("[pad]\ngrid = 2\n", "design compare --vary pad.grid=2,0", "pad.toml with --vary: [pad] grid: got 0"),
        ("", "design compare --vary pad.grid=3,3", "two pads have this name"),
        ("[contact]\ndepth_mm = 0.5\n", "design compare --vary contact.thickness_mm=1,6", "the pad is 1 mm thick"),
        ("", "fabricate check m.json --picture a.jpg", "--picture is a.jpg, allowed is a name that ends in .png"),
        ('[localizer]\nmethod = "published"\n', "run --time-budget 9", "method: got published with --time-budget"),
        ("[pad]\npitch_mm = 0.3\n", "run", "ridge_width_mm"),
        ('[rig]\nplan = "adaptive"\n', "run", "[rig] plan is adaptive"),
        ('[rig]\nplan = "deep.csv"\n', "run", "[rig] presses 6 mm deep, allowed is less than 6 mm"),
        (f"[pad]\nkeep_out_mm = [{WHOLE}]\n", "run", "[pad] keep_out_mm leaves 0.0% of what is pressed"),
        ('[pad]\n"\\u001b]0;title\\u0007\\u009b2J\\u202eä" = 1\n', "run", r"[pad] \x1b]0;title\x07\x9b2J\u202eä: no"),
    ],
)
def test_mistakes_are_refused_in_one_line(tmp_path: Path, settings: str, words: str, said: str) -> None:
    """What would fail late, too: before anything is done."""
    (tmp_path / "pad.toml").write_text(settings)
    (tmp_path / "deep.csv").write_text("x_mm,y_mm,depth_mm\n1,2,6\n")
    assert said in refused(*words.split(), cwd=tmp_path)


def test_missing_library_is_told_with_the_extra_of_the_command(tmp_path: Path, golden, monkeypatch) -> None:
    (tmp_path / "out" / "pad").mkdir(parents=True)
    lines = []
    for word, command in cli.commands.items():
        monkeypatch.setattr(command, "callback", Mock(side_effect=ModuleNotFoundError(name="matplotlib")))
        lines.append(f"{word}: {called(word, *list(getattr(command, 'commands', ()))[:1], cwd=tmp_path).err}")
    golden("padforge/missing_library.txt", "".join(lines))


def test_only_the_genetic_search_needs_pymoo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is refused before anything is written, and the line names the extra."""

    def version_without_pymoo(name: str) -> str:
        if name == "pymoo":
            raise metadata.PackageNotFoundError(name)
        return metadata.version(name)

    monkeypatch.setattr("padforge.common.files.installed_version", version_without_pymoo)
    (tmp_path / "pad.toml").write_text(SMALLEST)
    said = refused("design", "--method", "genetic", cwd=tmp_path)
    assert said == "padforge: this needs pymoo, which is not installed: pip install 'padforge[design]'\n"
    ended = called("design", cwd=tmp_path)
    assert ended.code in (0, 1), ended
    assert (tmp_path / "out" / "pad" / "morphology.json").is_file()


def test_processes_and_tests_import_one_padforge(tmp_path: Path) -> None:
    """Where a wheel is tested it is that; benches come from the checkout, as a wheel has none.

    A checkout shows `design` beside a lab's own folder of that name only to who works in the checkout. Compiled kernels
    are those of the tests: else each session would compile all of them twice.
    """
    code = (
        "import padforge.design.morphology as m, padforge, padforge.common.compilation as c;"
        "print(m.__name__, m.Morphology is padforge.Morphology, m.__file__, c.cache_folder(), sep='|')"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    name, is_same, path, cache = done.stdout.strip().split("|")
    assert (name, is_same, cache) == ("padforge.design.morphology", "True", str(compilation.cache_folder()))
    assert not [finder for finder in sys.meta_path if type(finder).__module__.startswith("padforge")]
    if "PADFORGE_WHEEL" in os.environ:  # a checkout may be tested, too
        installed = Path(sysconfig.get_path("purelib")) / "padforge"
        modules = {name: module.__file__ for name, module in sys.modules.items() if name.split(".")[0] == "padforge"}
        assert len(modules) > 10
        for name, file in modules.items():
            assert file is None or name.startswith("padforge.benchmarks") or Path(file).is_relative_to(installed), name
        assert Path(path).parent == installed / "design"
