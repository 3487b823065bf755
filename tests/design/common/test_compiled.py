"""Compiled kernels are kept until the sources of their package change, whichever file it is."""

import subprocess
import sys

import pytest

from design.common.computing import forget_outdated

KERNELS = {
    "__init__.py": "from pathlib import Path\nfrom design.common.computing import forget_outdated\n"
    "forget_outdated(Path(__file__).parent)\n",
    "inner.py": "from numba import njit\n@njit(cache=True)\ndef inner(x):\n    return x + 1\n",
    "outer.py": "from numba import njit\nfrom .inner import inner\n@njit(cache=True)\ndef outer(x):\n"
    "    return 10 * inner(x)\n",
}


@pytest.fixture
def package(tmp_path):
    folder = tmp_path / "kernels"
    folder.mkdir()
    for name, text in KERNELS.items():
        (folder / name).write_text(text)
    return folder


def outer_of_one(package):
    code = (
        f"import sys; sys.path.insert(0, {str(package.parent)!r})\n"
        "from kernels.outer import outer\nprint(outer(1), sum(outer.stats.cache_hits.values()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return tuple(map(int, done.stdout.split()))


def test_a_change_in_what_a_kernel_calls_is_compiled_in(package):
    assert outer_of_one(package) == (20, 0)
    assert outer_of_one(package) == (20, 1)
    (package / "inner.py").write_text(KERNELS["inner.py"].replace("x + 1", "x + 2"))
    assert outer_of_one(package) == (30, 0)


def test_a_folder_that_cannot_be_written_is_left_alone(package):
    (package / "__pycache__").touch()
    forget_outdated(package)
    assert (package / "__pycache__").is_file()


def test_a_damaged_stamp_is_no_stamp(package):
    kept = package / "__pycache__"
    kept.mkdir()
    (kept / "outer.py311.1.nbc").touch()
    (kept / "kernels.sha256").write_bytes(b"\xff\xfe")
    forget_outdated(package)
    assert not list(kept.glob("*.nbc"))
