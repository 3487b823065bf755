"""Files as other labs' programs write them, by the mapping that their page of errors suggests."""

import re
import struct
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io

from padforge.common.validation import InputError
from padforge.sense import Recording, import_bag, import_csv
from padforge.sense.formats.import_export import import_file
from padforge.sense.recording.doubts import find_doubts
from tests.helpers.golden import Golden

from .foreign import LAB_COLUMNS, array, header, lab, make, pose, write_bag, write_ros1_bag

N = 156
TIMES = np.arange(N) / 20
PRESSED = np.arange(N) % 24 // 12 * (np.arange(N) < 144)
"""6 presses of 12 readings, after 12 without."""
BEGIN = np.flatnonzero(np.diff(PRESSED, prepend=0) == 1)
SPOTS = np.array([[-10, -10], [10, -10], [10, 10], [-10, 10], [0, 5], [5, 0]])[np.minimum(np.arange(N) // 24, 5)]
VOLTS = 1.8 + 0.1 * PRESSED[:, None] * [1.0, 0.7, 0.4, 0.2] + np.random.default_rng(0).normal(0, 0.002, (N, 4))
VOLTS = VOLTS.round(4)
MAPPING = "time=t,fibres=c*"


def rows(time: Callable[[int], str] = lambda i: f"{TIMES[i]:.3f}", separator: str = ",") -> list[str]:
    return [separator.join([time(i), *(f"{volt:.4f}" for volt in VOLTS[i])]) for i in range(N)]


def table(header: str = "t,c0,c1,c2,c3", lines: list[str] | None = None) -> str:
    return "\n".join([*filter(None, [header]), *(lines or rows())]) + "\n"


def check(recording: Recording) -> None:
    """Check that a recording is the one of this page, with presses or as detected."""
    assert recording.readings.shape == (N, 4)
    np.testing.assert_allclose(recording.readings, VOLTS, atol=1e-9)
    np.testing.assert_allclose(recording.times_s - recording.times_s[0], TIMES, atol=1e-5)
    assert len(recording.down_command) == 6


def outcome(path: Path, mapping: str, **options: Any) -> str:
    """What is read of a file, in a line for each quantity, or the one line of its refusal."""
    try:
        recording = import_file(path, mapping, **options)
    except InputError as error:
        return f"refused: {error}"
    readings, steps = recording.readings, np.diff(recording.times_s)
    as_written = readings.shape == VOLTS.shape and np.allclose(readings, VOLTS, atol=1e-9)
    missing = np.argwhere(np.isnan(readings)).tolist()
    volts = f"of {np.nansum(readings, axis=0).round(4).tolist()} V in all, missing "
    volts += f"{missing if len(missing) < 6 else len(missing)}"
    lines = [f"{len(readings)} readings {'as written' if as_written else volts}"]
    lines[0] += f", from {steps.min():.4f} to {steps.max():.4f} s apart, {recording.times_s[-1]:.3f} s at last"
    lines.append(f"presses {recording.down_command.tolist()} to {recording.up_command.tolist()}")
    for name in ("presses_mm", "depths_mm", "reached_mm", "forces_n"):
        if not np.isnan(values := getattr(recording, name)).all():
            lines.append(f"{name} {values.round(2).tolist()}")
    about = {name: value for name, value in recording.source.items() if name not in ("kind", "file", "columns")}
    return "\n".join([*lines, f"{about}", *find_doubts(recording)])


def with_commas(text: str) -> str:
    return text.replace(",", ";").replace(".", ",")


def quoted(text: str, separator: str = ",") -> str:
    return re.sub(rf"[^\n{separator}]+", r'"\g<0>"', text).replace(separator, ",")


def with_columns(names: str, cells: Callable[[int], str]) -> str:
    """The table with more columns, and their cells."""
    return table(f"t,c0,c1,c2,c3,{names}", [f"{line},{cells(i)}" for i, line in enumerate(rows())])


def clock(seconds: float) -> str:
    return f"{int(seconds // 3600) % 24:02d}:{int(seconds // 60) % 60:02d}:{seconds % 60:06.3f}"


def clocked(i: int) -> str:
    return clock(36000 + i / 20)


RECEIVED = [line.replace(",", " -> ", 1) for line in rows(clocked)]
"""Lines as the monitor of an IDE keeps them, each behind the time at which it came."""
EVENLY: dict[str, tuple[str | bytes, str]] = {
    "blanks": (table().replace(",", " "), MAPPING),
    "UTF-8 with a mark": ("\ufeff" + table(), MAPPING),
    "all cells in quotes": (quoted(table()), MAPPING),
    "blanks, CR and LF": (table().replace(",", " , ").replace("\n", "\r\n") + "\r\n\r\n", MAPPING),
    "comments": ("# of a probe\n\n# spring; warm\n" + table().replace("\n3.000", "\n# knocked at\n\n3.000"), MAPPING),
    "tabs, names in a comment": ("# by hand\n#" + table().replace(",", "\t"), MAPPING),
    "names with separators": (table('"t;s,x","c;0",c1,c2,c3'), "time=t;s?x,fibres=c*"),
    "runs of blanks, no header": (table("").replace(",", "   "), "time=1,fibres=2-5"),
    "commas, no header": (table(""), "time=1,fibres=2-5"),
    "sep line": ("sep=;\r\n" + with_commas(table()), MAPPING),
    "quoted sep line": ('"sep=;"\n' + with_commas(table()), MAPPING),
    "UTF-16": (("\ufeff" + table()).encode("utf-16-le"), MAPPING),
    "UTF-16 without a mark": (table().encode("utf-16-le"), MAPPING),
    "cp1252": (table("t [\xb5s],c0,c1,c2,c3", rows(lambda i: str(50000 * i))).encode("cp1252"), "time=t*,fibres=c*"),
    "unit row": (table("t,c0,c1,c2,c3\nms,V,V,V,V", rows(lambda i: str(50 * i))), MAPPING),
    "preamble": ("DAQ log\nRate,20 Hz\n\n" + table(), MAPPING),
    "preamble of a sheet": ("DAQ log,,,,\nRate,20,,,\n,,,,\n" + table(), MAPPING),
    "ISO dates": (table(lines=rows(lambda i: f"2026-03-01 {clocked(i)}")), MAPPING),
    "ISO dates of UTC": (table(lines=rows(lambda i: f"2026-03-01T{clocked(i)}Z")), MAPPING),
    "over midnight": (table(lines=rows(lambda i: clock(86397.45 + i / 20))), MAPPING),
    "IDE monitor": (table("", RECEIVED), "time=1,fibres=2-5"),
    "no time": (table("c0,c1,c2,c3", [line.split(",", 1)[1] for line in rows()]), "rate=20,fibres=c*"),
    "decimal commas in quotes": (quoted(with_commas(table()), ";"), MAPPING),
    "thousands": (table(lines=rows(lambda i: f'"{1000 + i * 50:,}"')), "time=t:ms,fibres=c*"),
    "comma at the end": (table(lines=[f"{line}," for line in rows()]), MAPPING),
    "power cut": (table(lines=[*rows()[:70], "\0\0\0" + rows()[70], *rows()[71:]]), MAPPING),
    "boot bytes": (b"\x00\xff" + table().encode(), MAPPING),
    "boot lines": ("ets Jun 8 2016\nrst:0x1 (POWERON_RESET)\n" + table(), MAPPING),
    "repeated header": (table(lines=[*rows()[:70], "t,c0,c1,c2,c3", *rows()[70:]]), MAPPING),
    "torn end": (table() + "7.80,1.8,1.", MAPPING),
    "clock wraps": (table(lines=rows(lambda i: str((4294000000 + 50000 * i) % 2**32))), "time=t:us,fibres=c*"),
    "equal times": (table(lines=rows(lambda i: f"{TIMES[i - i % 4]:.3f}")), MAPPING),
    "booleans": (with_columns("on", lambda i: str(PRESSED[i] == 1)), f"{MAPPING},press=on"),
    "names in the header of a monitor": (table("10:00:00.000 -> c0,c1,c2,c3", RECEIVED), "time=received,fibres=c*"),
}


def changed(row: int, line: str, header: str = "t,c0,c1,c2,c3", instead_of: int = 1) -> str:
    """The table with another line in place of one or two."""
    return table(header, [*rows()[:row], line, *rows()[row + instead_of :]])


def positioned(scale: float = 1.0, jitter: float = 0.0, late: int = 0, held: bool = False, time: str = "") -> str:
    noise = np.random.default_rng(1).normal(0, jitter, (N, 2)) if jitter else np.zeros((N, 2))
    lines = [
        f"{line},{x:.5f},{y:.5f}" if (i >= late if held else PRESSED[i]) else f"{line},,"
        for i, (line, (x, y)) in enumerate(
            zip(rows(lambda i: str(50 * i)) if time else rows(), SPOTS * scale + noise, strict=True)
        )
    ]
    return table(f"t{time},c0,c1,c2,c3,px,py", lines)


def measured(other: str = "mV") -> str:
    """A table whose times and volts have their units behind them."""
    units = ("mV", other)
    lines = [
        ",".join([f"{1000 * TIMES[i]:.1f} ms", *(f"{1000 * volt:.1f}{units[i % 2]}" for volt in VOLTS[i])])
        for i in range(N)
    ]
    return table(lines=lines)


def named(separator: str) -> str:
    names = ["t", "c0", "c1", "c2", "c3"]
    cells = [zip(names, row.split(","), strict=True) for row in rows()]
    return table("", [separator.join(f"{name}:{value}" for name, value in row) for row in cells])


def dated(form: str) -> str:
    start = datetime(2026, 3, 1, 11, 59, 58)
    return table("t;c0;c1;c2;c3", rows(lambda i: form.format(start + timedelta(seconds=i / 20)), ";"))


WITH_PLACES, WITH_FORCE = f"{MAPPING},x=px,y=py", f"{MAPPING},force=fz"
TURNED = with_columns("fz", lambda _: "-2.5")
MERGED = [[f"{line},,", f"{TIMES[i] + 0.013:.3f},,,,,{SPOTS[i, 0]},{SPOTS[i, 1]}"] for i, line in enumerate(rows())]
TORN = [",".join([*line.split(",")[1:], line.split(",")[0]]) for line in rows()]
TORN[70:72] = [TORN[70][:9] + TORN[71]]
OWN = ["0,1,2,,", "1,1,2,3,4", "2,1,2,3,4", "3,1,2,,", "4,1,2,-1,0", "5,1,2,,"]
"""Lines of the program's own format, with two presses."""
NO_NUMBERS = {cell: [*OWN[:2], f"2,1,{cell},3,4", *OWN[3:]] for cell in ("1_0", "1 2", "1e", "?")}
PARTLY = ["0,1,2,,", "1,,2,?,?", "2,nan,2,?,?", "3,1,2,,", "4,1,2,-1,0", "5,1,,,", "6,1,2,?,?", "7,1,2,,", ""]
LAB = """# bench 2
t_ms;ch1;ch2;note;px;py;contact;f
0;1000,5;2000;begin;1,5;2;0;0
100;1001;2000;;1,5;2;1;200
200;;2000;loud;1,5;2;1;250
300;1000;2000;;-0,5;2;0;0
400;1000;2000;;-0,5;2;1;500
500;1000;2000;end;-0,5;2;0;0
"""


def own(*lines: str, header: str = "time_s,a,b,x_mm,y_mm") -> str:
    return table(header, list(lines))


REMARKABLE: dict[str, tuple[str, str]] = {
    "dates of America": (dated("{:%m/%d/%Y %I:%M:%S.%f %p}"), MAPPING),
    "dates of Germany": (dated("{:%d.%m.%Y %H:%M:%S,%f}"), MAPPING),
    "numbers with names": (named(","), MAPPING),
    "numbers with names, tabs": (named("\t"), MAPPING),
    "numbers with units": (measured(), MAPPING),
    "numbers of two units": (measured(other=" V"), MAPPING),
    "last line torn": (table(lines=[*rows(), "7.8,1.8"]), MAPPING),
    "a value too many": (changed(70, rows()[70] + ",1"), MAPPING),
    "a time that goes back": (changed(70, "0.000," + rows()[70].split(",", 1)[1]), MAPPING),
    "a word": (changed(30, "1.500,what,1.8,1.8,1.8"), MAPPING),
    "words for what is missing": (changed(30, "1.500,#N/A,ovf,inf,1.8"), MAPPING),
    "a line torn, and one of a later time": (changed(70, rows()[70][:12] + rows()[80], instead_of=2), MAPPING),
    "a line torn, time in the last column": (table("c0,c1,c2,c3,t", TORN), MAPPING),
    "two runs": (table(lines=rows() + rows()), MAPPING),
    "merged sources": (table("t,c0,c1,c2,c3,x,y", [line for pair in MERGED for line in pair]), f"{MAPPING},x=x,y=y"),
    "positions that are measured": (positioned(jitter=0.02), WITH_PLACES),
    "positions that are always measured": (positioned(jitter=0.02, held=True, late=5), WITH_PLACES),
    "positions in m": (positioned(scale=0.001), WITH_PLACES),
    "times in ms that are said to be s": (positioned(time=" [s]"), WITH_PLACES.replace("=t", "=t*", 1)),
    "times in ms, without positions": (table(lines=rows(lambda i: str(50 * i))), MAPPING),
    "counts of 10 bits": (table(), f"{MAPPING}:310"),
    "counts of 14 bits": (table(), f"{MAPPING}:5000"),
    "force": (with_columns("fz", lambda _: "2.5"), WITH_FORCE),
    "force a little below 0": (with_columns("fz", lambda i: "-0.02" if 78 < i < 98 else "2.5"), WITH_FORCE),
    "force that points the other way": (TURNED, WITH_FORCE),
    "force in mN that points the other way": (TURNED, f"{WITH_FORCE}:mN"),
    "force that is turned": (TURNED, f"{WITH_FORCE}:-1"),
    "own, positions unknown and readings missing": (own(*PARTLY), ""),
    "own, a word in a column": (own(*OWN, *["6,1,two,,"] * 4), ""),
    "own, one of x and y": (own(*OWN, "# here", "6,1,2,3,"), ""),
    "own, lines torn": (own(*OWN, *["6,1"] * 4), ""),
    "other units": (
        with_columns("on,y", lambda i: f"{int(PRESSED[i])},{1000 * i}"),
        "time=t:min,fibres=c0:uV,fibres=c1:0.5,x=c2:m,y=y:um,depth=c3:cm,press=on",
    ),
    "own, presses detected": (table("time_s,a,b,c,d"), ""),
    "own, presses detected, no positions": (table("time_s,a,b,c,d,x_mm,y_mm", [f"{line},," for line in rows()]), ""),
    "no mapping": (table(), ""),
    "a mapping without a quantity": (table(), "t"),
    "x without y": (table(), f"{MAPPING},x=c3"),
    "a unit that is none": (table(), "time=t:volt,fibres=c*"),
    "a column twice": (table(), "time=c1,fibres=c1"),
    "no such column": (table(), "time=t_ms,fibres=c*"),
    "own, no press": (own("0,1", "1,1", header="time_s,a"), ""),
    **{f"own, {cell!r} for a number": (own(*lines), "") for cell, lines in NO_NUMBERS.items()},
    "semicolons and all quantities": (LAB, "time=t_ms:ms,fibres=ch*:mV,x=px:cm,y=py:cm,press=contact,force=f:mN"),
}
"""Tables of which something is to be said, or which are refused."""


@pytest.mark.parametrize("name", EVENLY)
def test_tables_of_other_programs_are_read_alike(tmp_path: Path, name: str) -> None:
    content, mapping = EVENLY[name]
    (tmp_path / "lab.csv").write_bytes(content.encode() if isinstance(content, str) else content)
    check(import_csv(tmp_path / "lab.csv", mapping))


def test_what_is_said_of_tables(golden: Golden, tmp_path: Path) -> None:
    lines = []
    for name, (content, mapping) in REMARKABLE.items():
        (tmp_path / "lab.csv").write_text(content)
        lines += [f"-- {name}", outcome(tmp_path / "lab.csv", mapping)]
    golden("formats/tables.txt", "\n".join(lines))


@pytest.mark.parametrize("cut", [6, 9, 12, 13, 20, None])
@pytest.mark.parametrize("unit", ["s", "ms"])
def test_import_csv_reads_the_line_that_follows_a_torn_one_in_its_line(tmp_path, cut: int | None, unit: str) -> None:
    lines = rows(lambda i: f"{TIMES[i]:.3f}" if unit == "s" else str(10000 + 50 * i))
    lines[70:72] = [lines[70][:cut] + lines[71]]
    (tmp_path / "lab.csv").write_text(table(lines=lines))
    recording = import_csv(tmp_path / "lab.csv", f"time=t:{unit},fibres=c*")
    np.testing.assert_allclose(recording.readings, np.delete(VOLTS, 70, axis=0), atol=1e-9)
    np.testing.assert_allclose(np.diff(recording.times_s)[69:71], [0.1, 0.05])
    note = "line 72 is read from where another line begins in it: one was cut off"
    assert str(recording.source["note"]).startswith(note)


def test_presses_of_a_table_of_their_own(tmp_path: Path) -> None:
    lines = [f"{TIMES[i]:.3f},{SPOTS[i, 0]},{SPOTS[i, 1]}" for i in BEGIN]
    (tmp_path / "lab.csv").write_text(table())
    for names, mapping, more in (
        ("down_s,x_mm,y_mm,duration_s,force_n", "", "0.6,2.5"),
        ("at,px,py,for,f", "down=at,duration=for:ms,x=px,y=py,force=f:mN", "600,2500"),
    ):
        (tmp_path / "presses.csv").write_text(table(names, [f"{line},{more}" for line in (*lines, "99,0,0")]))
        recording = import_file(tmp_path / "lab.csv", MAPPING, presses=tmp_path / "presses.csv", press_columns=mapping)
        check(recording)
        assert recording.down_command.tolist() == BEGIN.tolist()
        assert recording.up_command.tolist() == (BEGIN + 12).tolist()
        assert recording.presses_mm.tolist() == SPOTS[BEGIN].tolist()
        assert (recording.forces_n == 2.5).all()
        assert recording.source["note"] == "1 of 7 presses lie outside of the readings, and are left out"


def test_recording_from_arrays(tmp_path: Path) -> None:
    presses = {"presses_mm": SPOTS[BEGIN], "forces_n": np.ones(6)}
    recording = Recording.from_arrays(VOLTS, TIMES, down_s=TIMES[BEGIN], up_s=TIMES[BEGIN + 12], **presses)
    check(recording)
    assert recording.down_command.tolist() == BEGIN.tolist()
    recording.save(tmp_path / "run")
    assert Recording.open(tmp_path / "run") == recording
    check(Recording.from_arrays(VOLTS, TIMES))


MATRIX = np.column_stack([TIMES, VOLTS, PRESSED])


def mat73(path: Path, content: dict[str, Any], kind: str = "double") -> Path:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in content.items():
            dataset = file.create_dataset(name, data=np.atleast_2d(values).T)
            dataset.attrs["MATLAB_class"] = np.bytes_(kind)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(116) + b" " * 8 + b"\x00\x02IM")
    return path


def opaque(path: Path, name: bytes, kind: bytes) -> Path:
    """Write a MATLAB 5 file with an object of a class that only MATLAB reads."""

    def element(number: int, data: bytes) -> bytes:
        return struct.pack("<II", number, len(data)) + data + bytes(-len(data) % 8)

    numbers = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 1, 6)) + element(1, b"")
    inner = element(14, numbers + element(6, struct.pack("<6I", *range(6))))
    labels = element(1, name) + element(1, b"MCOS") + element(1, kind)
    outer = element(14, element(6, struct.pack("<II", 17, 0)) + labels + inner)
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<HH", 0x0100, 0x4D49) + outer)
    return path


def published_variables(**changes: Any) -> dict[str, Any]:
    """Return the variables of a published file of three presses, with changes; None leaves one out."""
    rng, tim = np.random.default_rng(0), np.arange(120.0)[None] / 13
    content = {"voltage": rng.uniform(1, 2, (120, 4)), "pos": rng.uniform(-9, 9, (2, 3)), "tim": tim}
    return {name: value for name, value in (content | changes).items() if value is not None}


def test_what_is_said_of_files_of_matlab(golden: Golden, tmp_path: Path) -> None:
    """Structures, columns of a matrix, objects that only MATLAB reads, and files as published."""
    content = {"data": {"t": TIMES, "in": {"v": VOLTS}}, "x": MATRIX}
    scipy.io.savemat(tmp_path / "old.mat", content)
    mat73(tmp_path / "new.mat", {"data/t": TIMES[:, None], "data/in/v": VOLTS, "x": MATRIX})
    opaque(tmp_path / "opaque.mat", b"data", b"timetable")
    mat73(tmp_path / "timetable.mat", {"data": np.ones((1, 6), np.uint32)}, "timetable")
    scipy.io.savemat(tmp_path / "cells.mat", {"t": TIMES, "v": np.array([VOLTS, 1], dtype=object)})
    volts, positions, times = (published_variables()[name] for name in ("voltage", "pos", "tim"))
    holed = volts.astype(np.float32)
    holed[:, 2] = holed[50:55] = np.nan
    for name, changes in {
        "published": {},
        "cut": {"voltage": volts[:111], "tim": times[:, :111]},
        "more": {"voltage": volts[:100], "tim": times[:, :100], "pos": positions[:, :2]},
        "short": {"voltage": volts[:79]},
        "sparse": {"voltage": scipy.sparse.csc_matrix(volts)},
        "counts": {"voltage": np.rint(volts * 200).astype(np.uint16)},
        "holed": {"voltage": holed, "tim": times.T, "pos": positions.T},
        "blind": {"pos": None},
        "partly": {"pos": np.where([True, False, True], positions, np.nan)},
    }.items():
        scipy.io.savemat(tmp_path / f"{name}.mat", published_variables(**changes))
    columns = (*(f"time=x[0],fibres=x[1:5],press=x[{at}]" for at in (5, 7)), "time=x[:,0],fibres=x[:,1:5]")
    structure = ("time=data.t,fibres=data.in.v", "time=/data/t,fibres=/data/in/v", *columns, "")
    table = ("", "rate=20,fibres=data", "time=data.Time,fibres=data.v")
    mappings = dict.fromkeys(("old", "new"), structure) | dict.fromkeys(("opaque", "timetable"), table)
    golden("formats/matlab.txt", outcomes(tmp_path, "*.mat", mappings | {"cells": ("time=t,fibres=v",)}))


def outcomes(folder: Path, pattern: str, mappings: Mapping[str, Sequence[str]]) -> str:
    """Return what is read of the files in a folder by their mappings, or without one."""
    lines = []
    for path in sorted(folder.glob(pattern)):
        for mapping in mappings.get(path.stem, ("",)):
            lines += [f"-- {path.name} {mapping}", outcome(path, mapping)]
    return "\n".join(lines)


def test_what_is_said_of_hdf5_files(golden: Golden, tmp_path: Path) -> None:
    """Columns of tables, frames along either axis, and commands as indices or as times."""
    with h5py.File(tmp_path / "lab.h5", "w") as file:
        kinds = [("t", "f8"), *((f"c{i}", "f4" if i else "f8") for i in range(4)), ("on", "u1")]
        file["log/table"] = np.array([tuple(row) for row in MATRIX], kinds)
        file["data"], file["t_ns"], file["note"] = MATRIX, (TIMES * 1e9).astype(np.int64), "bench 2"
        file["frames"], file["last"] = VOLTS.reshape(N, 2, 2), np.moveaxis(VOLTS.reshape(N, 2, 2), 0, -1)
        file["tenths_of_mv"], file["xy"] = (1e4 * VOLTS.T).round().astype(np.int16), SPOTS[BEGIN] / 10
        file["on"], file["off"] = BEGIN, BEGIN + 12
        file["on_ms"], file["off_ms"] = 50 * BEGIN, 50 * BEGIN + 600
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = np.arange(3)
    pressed = "time=/t_ns:ns,fibres=/tenths_of_mv:1e-4,positions=/xy:cm,down_command=/on{0},up_command=off{0}"
    mappings = (
        "",
        "time=log/table/t,fibres=log/table/c*,press=log/table/on",
        "time=/data[0],fibres=/data[1:5]",
        "time=t_ns:ns,fibres=frames",
        "time=t_ns:1e-9,fibres=last",
        "rate=20,fibres=frames",
        pressed.format(""),
        pressed.format("_ms:ms"),
        "time=t_ns:ns,fibres=note",
    )
    golden("formats/hdf5.txt", outcomes(tmp_path, "*.h5", {"lab": mappings}))


@pytest.mark.parametrize("kind", ["csv", "mat73", "mcap"])
def test_fibres_are_in_the_order_of_their_numbers_and_it_is_said(tmp_path: Path, kind: str) -> None:
    levels = 1 + np.arange(1, 13) / 100
    volts = np.where(PRESSED[:, None], levels + 0.1, levels) + np.random.default_rng(0).normal(0, 1e-4, (N, 12))
    names = sorted((f"c{i}" for i in range(1, 13)), key=lambda name: name[::-1])
    content = {"t": TIMES} | {name: volts[:, int(name[1:]) - 1] for name in names}
    path = tmp_path / f"lab.{kind}"
    if kind == "csv":
        lines = [",".join(str(content[name][i]) for name in content) for i in range(N)]
        path.write_text(table(",".join(content), lines))
    elif kind == "mat73":
        path = mat73(tmp_path / "lab.mat", content)
    else:
        messages = [(f"/{name}", TIMES[i], make("Float64", content[name][i])) for i in range(N) for name in names]
        path = write_bag(tmp_path / "bag", messages)
    recording = import_file(path, "fibres=/c*" if kind == "mcap" else MAPPING)
    np.testing.assert_allclose(recording.readings[0], levels, atol=0.01)
    assert [name.strip("/") for name in recording.fibre_names] == [f"c{i}" for i in range(1, 13)]
    assert "fibre 2 = " in recording.source["note"]
    assert "fibre 12 = " in recording.source["note"]


def test_import_bag_holds_late_poses_spreads_bursts_and_reads_bags_of_ros_1(tmp_path: Path) -> None:
    messages = []
    for i in range(N):
        messages.append(("/skin", TIMES[i - i % 2], array("Float64MultiArray", VOLTS[i])))
        if i >= 5:
            jitter = np.random.default_rng(i).normal(0, 1e-5, 2)
            messages.append(("/pose", TIMES[i] + 0.001, pose(*(SPOTS[i] / 1000 + jitter))))
    recording = import_bag(write_bag(tmp_path / "bag", messages), "fibres=/skin,positions=/pose")
    check(recording)
    np.testing.assert_allclose(recording.presses_mm[3], [-10, 10], atol=0.1)
    check(import_bag(write_ros1_bag(tmp_path / "lab.bag", "/skin", TIMES + 1.7e9, VOLTS), "fibres=/skin"))


FLAGS = ("/never", 0.2, False), ("/before", 0.0, True), ("/before", 0.01, False)


def test_what_is_said_of_bags(golden: Golden, tmp_path: Path) -> None:
    """Fields of messages, a position below other fields, several numbers for one, and lengths that change."""
    still = make("TwistWithCovariance", make("Twist", *[make("Vector3", 0.0, 0.0, 0.0)] * 2), np.zeros(36))
    channels = [make("ChannelFloat32", "c", np.ones(n, np.float32)) for n in (2, 3)]
    numbers: dict[str, list[Any]] = {"some": [array("Float64MultiArray", np.ones(2))] * 9}
    numbers["lengths"] = [numbers["some"][0], array("Float64MultiArray", np.ones(3))]
    numbers["none"] = [numbers["some"][0], array("Float64MultiArray", np.ones(0))]
    messages: dict[str, list[Any]] = {
        name: [("/f", i / 20, m) for i, m in enumerate(each)] for name, each in numbers.items()
    }
    messages["some"] += [
        *(("/cloud", 0.0, make("PointCloud", header(), [], channels)), ("/words", 0.0, make("String", "a"))),
        *((topic, time, make("Bool", on)) for topic, time, on in FLAGS),
    ]
    messages["poses"], messages["odometry"] = [], []
    for time, volts, spot in zip(TIMES, VOLTS, SPOTS / 1000, strict=True):
        messages["poses"].append(("/all", time, make("Pose", make("Point", *spot, 0.0), make("Quaternion", *volts))))
        place = make("Pose", make("Point", *spot, 0.0), make("Quaternion", 0.0, 0.0, 0.0, 1.0))
        odometry = make("Odometry", header(), "base", make("PoseWithCovariance", place, np.zeros(36)), still)
        messages["odometry"] += [("/odom", time, odometry), ("/skin", time, array("Float64MultiArray", volts))]
    messages["lab"] = list(lab())
    for name, each in messages.items():
        write_bag(tmp_path / f"{name} bag", each).rename(tmp_path / f"{name}.mcap")
    axes = ",".join(f"fibres=/all.orientation.{axis}" for axis in "xyzw")
    mappings = {
        "poses": ("fibres=/all", f"{axes},positions=/all.position", "fibres=/all.position.q"),
        "odometry": ("fibres=/skin,positions=/odom",),
        "some": (
            *("fibres=/f.data,depth=/f", "fibres=/cloud", "fibres=/words", "fibres=/nowhere"),
            *("fibres=/f,press=/never", "fibres=/f,press=/before", ""),
        ),
        **dict.fromkeys(("lengths", "none"), ("fibres=/f",)),
        "lab": (LAB_COLUMNS, "fibres=/skin/?:0.01,press=/down,x=/at/x:mm,y=/at/y", "fibres=/camera"),
    }
    golden("formats/bags.txt", outcomes(tmp_path, "*.mcap", mappings))
