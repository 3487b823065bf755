"""Recordings, their plans and frames: what they come to, what is kept of them, and which words refuse them, whole."""

import json
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from padforge.common.progress import ignore_progress
from padforge.design import Contact, Morphology
from padforge.design.settings import PadSettings
from padforge.sense import Recorder, Recording
from padforge.sense.live.pipeline import Estimate, Live
from padforge.sense.localizer.evaluation import errors_by_moment
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.recording.doubts import area_mm, find_doubts, suggest_unit
from padforge.sense.recording.frames import FRAME_S, FrameStream, frame_rate_hz, framed, reading_edges, time_means
from padforge.sense.recording.press_plan import PressPlan, check_depths, describe_other_depth, make_plan, read_plan
from padforge.sense.recording.recording import check_replaceable
from padforge.sense.settings import RigSettings
from tests.helpers.presses import changed
from tests.helpers.refusals import refusal_table
from tests.helpers.rigs import RECTANGLE


def test_save_and_open_round_trip_and_torn_readings(recording: Recording, folder: Path) -> None:
    opened = Recording.open(folder)
    assert opened == recording
    assert (opened.digest, opened.source, opened.torn_presses) == (recording.digest, recording.source, 0)
    assert sorted(path.name for path in folder.parent.iterdir()) == ["run"]
    (folder.parent / "empty").mkdir()
    recording.save(folder.parent / "empty", {})  # an empty folder is filled
    assert Recording.open(folder.parent / "empty") == recording
    stream = folder / "readings.bin"
    stream.write_bytes(stream.read_bytes()[: -10 * 256 - 3])
    opened = Recording.open(folder)
    n_complete = len(opened.presses_mm)
    assert 0 < opened.torn_presses <= 2
    assert n_complete + opened.torn_presses == len(recording.presses_mm)
    assert np.array_equal(opened.presses_mm, recording.presses_mm[:n_complete])
    assert np.array_equal(opened.readings, recording.readings[: len(opened.readings)])


def test_equality_and_digest_treat_all_nan_alike(recording: Recording) -> None:
    other_nan = -np.array([0x7FF8000000000001], dtype=np.uint64).view(np.float64)[0]
    unknown = changed(recording, "presses_mm", 3, np.nan)
    one, other = (changed(unknown, "readings", (7, 0), nan) for nan in (np.nan, other_nan))
    assert one == other != recording
    assert one.digest == other.digest != recording.digest
    assert one.has_position.tolist() == [press != 3 for press in range(300)]


def test_recording_accepts_limits_and_uneven_times(recording: Recording, tmp_path: Path) -> None:
    assert replace(recording, down_command=recording.down_command.astype(float)) == recording
    for name, index, most in (("readings", (7, 0), -1e3), ("presses_mm", (3, 1), 1e5), ("times_s", -1, 1e10)):
        assert getattr(changed(recording, name, index, most), name)[index] == most
    uneven = np.cumsum(np.random.default_rng(0).exponential(0.07, len(recording.times_s)))
    assert replace(recording, times_s=uneven).rate_hz == pytest.approx(1 / 0.07 / np.log(2), rel=0.1)
    least = Recording(np.ones((2, 1)), np.arange(2.0), np.full((1, 2), np.nan), np.array([1]), np.array([2]))
    least.save(tmp_path / "run", {})
    assert Recording.open(tmp_path / "run") == least


def test_measures_are_saved_but_not_in_the_digest(recording: Recording, tmp_path: Path) -> None:
    count = len(recording.down_command)
    unknown = replace(recording, depths_mm=np.empty(0))
    assert np.isnan([unknown.depths_mm, unknown.reached_mm, unknown.forces_n]).all()
    reached = np.where(np.arange(count) % 2 == 0, np.nan, 4.9)
    measured = replace(recording, reached_mm=reached, forces_n=np.linspace(0, 9, count))
    assert measured != recording
    assert measured.digest == recording.digest == unknown.digest
    assert measured.actual_depths_mm[:4].tolist() == [5, 4.9, 5, 4.9]
    for number, each in enumerate((unknown, measured)):
        each.save(tmp_path / str(number), {})
        assert Recording.open(tmp_path / str(number)) == each
    with pytest.raises(ValueError, match="read-only"):
        measured.forces_n[0] = 1


def test_open_while_recording(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    readings = rng.standard_normal((30, 3))
    recorder = Recorder(tmp_path / "live", 3, {}, {})
    recorder.append(np.arange(20.0), readings[:20])
    recorder.begin((1.5, -2.5), 10)
    recorder.finish(20)
    recorder.append(np.arange(20.0, 26.0), readings[20:26])
    recorder.begin((3.0, 4.0), 26)
    recorder.sync()
    recorder.append(np.arange(26.0, 30.0), readings[26:])
    opened = Recording.open(tmp_path / "live")
    recorder.__exit__(None, None, None)
    assert np.array_equal(opened.readings, readings[:26])
    assert opened.presses_mm.tolist() == [[1.5, -2.5]]
    assert (opened.down_command.tolist(), opened.up_command.tolist()) == ([10], [20])


def test_open_needs_little_more_memory_than_the_readings(tmp_path: Path) -> None:
    """Neither the content of the file nor a second copy of the readings is kept."""
    readings, down = np.random.default_rng(0).normal(size=(30_000, 60)), np.arange(1, 30_000, 40)
    recording = Recording(readings, np.arange(30_000.0), np.zeros((len(down), 2)), down, down + 20)
    recording.save(tmp_path / "recording", {})
    tracemalloc.start()
    opened = Recording.open(tmp_path / "recording")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert opened == recording
    assert peak < 1.6 * (readings.nbytes + 8 * len(readings)) + 2**23


def make(size: PadSettings = RECTANGLE, **settings: Any) -> PressPlan:
    return make_plan(Morphology.straight(size.layout), RigSettings(**settings), np.random.default_rng(0), size)


@pytest.fixture
def made(tmp_path: Path) -> Recording:
    """Five presses, 10 readings each way, of two fibres at 10 Hz; made by hand, so that each number is known."""
    down = 10 + 20 * np.arange(5)
    readings = np.where(np.arange(110)[:, None] % 20 < 10, [1.5, 2.5], [1.6, 2.3])
    presses_mm = np.array([[0.0, 0.0], [10.0, -5.0], [-10.0, 5.0], [4.0, 12.5], [7.5, 2.0]])
    depths_mm, forces_n = np.array([[1.0, 2.0, 3.0, np.nan, 5.0], [np.nan, 2.5, 3.5, 4.5, 5.5]])
    recording = Recording(readings, np.arange(110) / 10, presses_mm, down, down + 10, {"kind": "made"})
    return replace(recording, depths_mm=depths_mm, forces_n=forces_n)


def test_plans_of_each_kind(golden) -> None:
    """10 presses on a pad of 16 x 45 mm with a hole; depths in turn."""
    lines = []
    for kind in ("uniform", "grid", "serpentine", "adaptive"):
        rows = make(presses=10, plan=kind, depths_mm=(1.0, 2.0, 4.0)).to_rows()
        lines += [f"# {kind}", *(",".join(f"{value:.4f}" for value in row) for row in rows)]
    golden("recordings/plans.csv", "\n".join(lines))


def test_run_directory_is_written_as_the_arrays_are(made: Recording, golden, tmp_path: Path) -> None:
    """And a press that is begun after it, and broken off, says where that was."""
    recording = replace(made, reached_mm=np.array([np.nan, 1.9, 3.1, 4.0, np.nan]))
    recording.save(tmp_path / "run", {"command": "test"})
    with Recorder.resume(tmp_path / "run") as recorder:
        recorder.append(11.0 + np.arange(7) / 10, np.ones((7, 2)))
        recorder.begin((1.5, -2.5), recorder.n_readings - 2, depth_mm=1.0)
        recorder.abort("the arm is gone")
    golden("recordings/start.json", (tmp_path / "run" / "start.json").read_text())
    golden("recordings/journal.ndjson", (tmp_path / "run" / "journal.ndjson").read_text())
    opened = Recording.open(tmp_path / "run")
    measures = {name: values.tolist() for name, values in opened.measures.items()}
    golden("recordings/measures.json", {**measures, "rate_hz": opened.rate_hz, "pad_digest": opened.pad_digest})


def test_arrays_and_plans_are_refused_in_these_words(made: Recording, golden, tmp_path: Path) -> None:
    def with_value(name: str, where: Any, value: float) -> Callable[[], object]:
        return partial(changed, made, name, where, value)

    def planned(content: str) -> Callable[[], object]:
        def plan() -> None:
            (tmp_path / "places.csv").write_text(content)
            make(plan=str(tmp_path / "places.csv"))

        return plan

    everything = ((-20.0, -40.0), (7.94, -40.0), (7.94, 40.0), (-20.0, 40.0))
    covered = RECTANGLE.model_copy(update={"keep_out_mm": (everything,)})
    rows: dict[str, Callable[[], object]] = {
        "one dimension": lambda: replace(made, readings=made.readings[:, 0]),
        "nothing read": lambda: replace(made, readings=np.full((110, 2), np.nan)),
        "readings too large": with_value("readings", (7, 0), -1e30),
        "half a position": with_value("presses_mm", (3, 1), np.nan),
        "times that go back": with_value("times_s", 9, 0.0),
        "a rate too high": lambda: replace(made, times_s=made.times_s * 1e-9),
        "a press that ends before it begins": with_value("up_command", 2, 45),
        "a press before the end of the one before": with_value("down_command", 2, 35),
        "a press beyond the end": with_value("up_command", 4, 111),
        "fewer ends": lambda: replace(made, up_command=made.up_command[:4]),
        "no press": lambda: replace(made, presses_mm=np.empty((0, 2))),
        "a depth above the pad": with_value("depths_mm", 1, -0.5),
        "a depth beyond all": with_value("reached_mm", 1, 2e5),
        "a force that pulls": with_value("forces_n", 1, -1.25),
        "a force beyond all": with_value("forces_n", 1, 1e9),
        "fewer forces": lambda: replace(made, forces_n=np.ones(3)),
        "source with NaN": lambda: replace(made, source={"gain": np.nan}),
        "source that is a list": lambda: replace(made, source=[1]),
        "one of two": lambda: Recording.from_arrays(made.readings, made.times_s, down_s=[1.0]),
        "no press in the readings": lambda: Recording.from_arrays(np.ones((30, 2)), made.times_s[:30]),
        "rows of two": lambda: PressPlan.from_rows([[1.0, 2.0]]),
        "fewer depths": lambda: PressPlan(np.zeros((3, 2)), np.ones(2)),
        "press of no depth": lambda: PressPlan(np.zeros((3, 2)), np.array([1.0, 0.0, 1.0])),
        "positions in um": lambda: PressPlan(np.full((3, 2), 1e6), np.ones(3)),
        "other columns": planned("x,y\n1,2\n"),
        "negative depth in a file": planned("x_mm,y_mm,depth_mm\n1,2,-1\n"),
        "in a keep-out": planned("x_mm,y_mm\n-3,2\n4,1\n"),
        "no place left": lambda: make(covered),
        "through the pad": lambda: check_depths(np.array([1.0, 6.5]), 6.5, "pad.toml"),
    }
    layer = Contact(model="layer", depth_mm=2.0)
    said = [describe_other_depth(np.array(depths), layer) for depths in ([1.0], [3.0, 0.5], [2.0, 5.0])]
    golden("recordings/refusals_of_arrays.txt", "\n".join([refusal_table(rows), *map(repr, said)]))


def test_folders_are_refused_in_these_words_and_left_as_they_are(made: Recording, golden, tmp_path: Path) -> None:
    made.save(tmp_path / "run", {})
    files = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}

    def opened(name: str, **change: Any) -> Callable[[], object]:
        """Open the recording with another start document or, by old and new words, another journal."""
        folder = tmp_path / name.replace(" ", "-")
        made.save(folder, {})
        if "old" in change:
            text = (folder / "journal.ndjson").read_text()
            assert change["old"] in text
            (folder / "journal.ndjson").write_text(text.replace(change["old"], change["new"], 1))
        else:
            document = json.loads((folder / "start.json").read_text())
            (folder / "start.json").write_text(json.dumps(document | change))
        return lambda: Recording.open(folder)

    def recorded(call: Callable[[Recorder], object]) -> Callable[[], object]:
        def record() -> None:
            with Recorder.resume(tmp_path / "run") as recorder:
                call(recorder)

        return record

    (tmp_path / "file").write_text("content")
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "notes.txt").write_text("mine")
    (tmp_path / "pad" / "recording").mkdir(parents=True)
    (tmp_path / "pad" / "recording" / "start.json").write_bytes(files["start.json"])
    (tmp_path / "link").symlink_to("run")
    made.save(tmp_path / "unread", {})
    (tmp_path / "unread" / "journal.ndjson").unlink()
    (tmp_path / "unread" / "journal.ndjson").mkdir()
    started, done = '"event": "started"', '"event": "done",'
    rows: dict[str, Callable[[], object]] = {
        "absent": lambda: Recording.open(tmp_path / "absent"),
        "a file": lambda: Recording.open(tmp_path / "file"),
        "the folder of a pad": lambda: Recording.open(tmp_path / "pad"),
        "a journal that is a folder": lambda: Recording.open(tmp_path / "unread"),
        "too many fibres": opened("fibres", fibres=513),
        "half a fibre": opened("half", fibres=2.5),
        "source": opened("source", source=[1]),
        "format": opened("format", format="padforge-recording/0"),
        "event": opened("event", old=started, new='"event": "began"'),
        "number": opened("number", old="{" + started, new="3\n{" + started),
        "no number": opened("no-number", old='"press": 0', new='"pres": 0'),
        "torn": opened("torn", old="{" + started, new="{event"),
        "place": opened("place", old=done, new=f'{done} "at_mm": [1, 2],'),
        "force": opened("force", old=done, new=f'{done} "force_n": "much",'),
        "written over": lambda: made.save(tmp_path / "run", {}),
        "onto a file": lambda: made.save(tmp_path / "file", {}),
        "below a file": lambda: Recorder(tmp_path / "file" / "run", 3, {}, {}),
        "among others": lambda: Recorder(tmp_path / "notes", 3, {}, {}),
        "a long name": lambda: made.save(tmp_path / ("n" * 300), {}),
        "replacing what no seed makes again": lambda: check_replaceable(tmp_path / "run"),
        "replacing other files": lambda: check_replaceable(tmp_path / "notes"),
        "replacing a file": lambda: check_replaceable(tmp_path / "file"),
        "replacing a link": lambda: check_replaceable(tmp_path / "link"),
        "no fibre": lambda: Recorder(tmp_path / "new", 0, {}, {}),
        "three numbers of two fibres": recorded(lambda r: r.append([0.0], [[1.0, 2.0, 3.0]])),
        "not begun": recorded(lambda r: r.finish(100)),
        "half of a position": recorded(lambda r: r.begin((1.0, np.nan), 100)),
        "no depth": recorded(lambda r: r.begin((0.0, 0.0), 100, depth_mm=np.nan)),
        "before the first": recorded(lambda r: r.begin((0.0, 0.0), -1)),
    }
    golden("recordings/refusals_of_folders.txt", refusal_table(rows), forget=[r"n{300}"])
    kept = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir() if path.name in files}
    assert kept == files
    assert (tmp_path / "file").read_text() == "content"
    assert [path.name for path in (tmp_path / "notes").iterdir() if path.suffix] == ["notes.txt"]
    assert not (tmp_path / "new").exists()


def test_doubts(made: Recording, golden) -> None:
    """About units of everything, and about presses far from the others."""
    many = np.tile(np.arange(200.0)[:, None] % 30, (1, 2)) * [1.0, -0.5]
    down = 10 + 20 * np.arange(200)
    readings = np.tile(made.readings[:20], (201, 1))
    long = Recording(readings, np.arange(4020) / 10, many, down, down + 10, {"kind": "made"})
    one, eight = many.copy(), many.copy()
    one[7], eight[7], eight[10:17, 1] = (250.0, 3.25), (250.0, 3.25), -300.0
    columns = {"columns": "time=t:s,x=px:mm,y=py,fibres=a0-a3:V"}
    times_s, presses_mm = made.times_s, made.presses_mm
    unknown = replace(made, presses_mm=np.where(np.arange(5)[:, None] < 4, np.nan, presses_mm))
    assert area_mm(unknown) is None
    cases = {
        "plausible": made,
        "of one known position": unknown,
        "far": replace(long, presses_mm=one),
        "eight far": replace(long, presses_mm=eight),
        "of few, none is far": replace(made, presses_mm=100 * presses_mm),
        "positions in m": replace(made, presses_mm=1e-3 * presses_mm),
        "positions in m, named": replace(made, presses_mm=1e-3 * presses_mm, source=columns),
        "positions in um": replace(made, presses_mm=1e3 * presses_mm),
        "times in ms": replace(made, times_s=1e3 * times_s),
        "times in us, named": replace(made, times_s=9e3 * times_s, source=columns),
        "times in ks": replace(made, times_s=1e-4 * times_s),
        "10 bits, named": replace(made, readings=300 * made.readings, source=columns),
    }
    lines = [line for name, case in cases.items() for line in (f"{name}:", *(f"    {d}" for d in find_doubts(case)))]
    for bits in (10, 12, 14, 16, 17):
        lines.append(f"{bits} bits: {suggest_unit({}, 'fibres', np.full((2, 2), 2.0**bits - 1))}")
    golden("recordings/doubts.txt", "\n".join(lines))
    low, high = np.percentile(one, [5, 95], axis=0)
    assert f"x = {low[0]:.4g} to {high[0]:.4g}, y = {low[1]:.4g} to {high[1]:.4g} mm" in lines[3]


def test_plan_of_a_file_has_its_depths_or_those_of_the_rig_in_turn(tmp_path: Path) -> None:
    for content, expected in (
        ("x_mm,y_mm\n1,2\n\n-3.5,4\n\n", [[1, 2, 2.5], [-3.5, 4, 1]]),
        ("x_mm,y_mm,depth_mm\n1,2,1.5\n", [[1, 2, 1.5]]),
    ):
        (tmp_path / "plan.csv").write_text(content)
        assert read_plan(tmp_path / "plan.csv", (2.5, 1)).to_rows() == expected


@pytest.mark.parametrize("counts", [(3, 6), (9, 1)])
def test_make_plan_grid_has_one_step_along_both_axes(counts: tuple[int, int]) -> None:
    size = PadSettings(horizontals=counts[0], verticals=counts[1], pitch_mm=(8.0, 15.0))
    for presses in (1, 2, 7, 60, 1500):
        positions = make(size, presses=presses, plan="grid").positions_mm
        assert len(positions) == len(np.unique(positions, axis=0)) == presses
        assert presses > 1 or np.abs(positions).max() < 1e-9  # a single one is in the middle
        steps = [np.diff(np.unique(positions[:, axis])) for axis in range(2)]
        if min(map(len, steps)) >= 8:
            assert steps[0].mean() == pytest.approx(steps[1].mean(), rel=0.1)


@pytest.mark.parametrize("kind", ["grid", "serpentine"])
def test_make_plan_depths_do_not_depend_on_the_position(kind: str) -> None:
    plan = make(PadSettings(), presses=361, plan=kind, depths_mm=(0.5, 1, 2, 3, 5))
    for axis in (0, 1):
        for value in np.unique(plan.positions_mm[:, axis]):
            assert len(set(plan.depths_mm[plan.positions_mm[:, axis] == value])) == 5


def repeated(recording: Recording, times: int) -> Recording:
    """Return a recording at `times` as many readings a second, of even frames; each reading is that many equal ones."""
    even_s = FRAME_S * np.arange(len(recording.readings))
    parts_s = FRAME_S * ((np.arange(times) + 0.5) / times - 0.5)
    return replace(
        recording,
        readings=np.repeat(recording.readings, times, axis=0),
        times_s=(even_s[:, None] + parts_s).ravel(),
        down_command=times * recording.down_command,
        up_command=times * recording.up_command,
    )


def uneven(rate_hz: float, seed: int, seconds: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    times_s = np.cumsum(rng.uniform(0.5, 1.5, int(seconds * rate_hz)) / rate_hz)
    readings = rng.standard_normal((len(times_s), 2))
    return times_s, np.where(rng.random(readings.shape) < 0.1, np.nan, readings)


@given(st.sampled_from((3.0, 11.0, 60.0, 400.0)), st.integers(0, 2**32 - 1))
def test_frames_are_means_over_time(rate_hz: float, seed: int) -> None:
    """Beside the sum over every reading of the time that it stands for within the frame."""
    times_s, readings = uneven(rate_hz, seed)
    edges = reading_edges(times_s)
    frame_edges = np.arange(edges[0], edges[-1], FRAME_S)
    means = time_means(edges, readings, frame_edges)
    for n in range(0, len(means), 7):
        begin, end = frame_edges[n : n + 2]
        within_s = np.clip(np.minimum(edges[1:], end) - np.maximum(edges[:-1], begin), 0, None)
        for fibre, mean in enumerate(means[n]):
            present = ~np.isnan(readings[:, fibre])
            read_s = within_s[present].sum()
            if read_s < 0.25 * FRAME_S:
                assert np.isnan(mean)
            else:
                assert mean == pytest.approx((within_s * readings[:, fibre])[present].sum() / read_s, abs=1e-9)


@pytest.mark.parametrize("rate_hz", [5.0, 31.0, 100.0, 1000.0])
def test_no_frame_mixes_what_was_before_a_command_with_what_came_after(rate_hz: float) -> None:
    times_s, readings = uneven(rate_hz, 0, seconds=20.0)
    commands = (len(times_s) * np.array([0.21, 0.44, 0.46, 0.9])).astype(int)
    level = np.searchsorted(commands, np.arange(len(times_s)), side="right")
    recording = Recording(
        readings * 0.0 + level[:, None].astype(float), times_s, np.zeros((2, 2)), commands[::2], commands[1::2]
    )
    frames = framed(recording)
    found = np.stack([frames.down_command, frames.up_command], axis=1).ravel()
    expected = np.searchsorted(found, np.arange(len(frames.readings)), side="right")
    seen = np.isfinite(frames.readings)
    assert seen.mean() > 0.9
    np.testing.assert_allclose(frames.readings[seen], np.broadcast_to(expected[:, None], seen.shape)[seen], atol=1e-9)
    assert abs(frames.times_s[found] - times_s[commands]).max() <= FRAME_S / 2 + 1 / rate_hz
    assert frames.rate_hz == pytest.approx(frame_rate_hz(rate_hz)) == pytest.approx(1 / FRAME_S)
    assert framed(frames) is frames


@pytest.mark.parametrize("rate_hz", [12.5, 13.3, 14.4])
def test_readings_of_about_the_length_of_a_frame_are_frames(rate_hz: float) -> None:
    times_s, readings = uneven(rate_hz, 1)
    recording = Recording(readings, times_s, np.zeros((1, 2)), np.array([5]), np.array([20]))
    assert framed(recording) is recording
    even_s = np.arange(40) / rate_hz
    times, means = FrameStream(rate_hz, 2).feed(even_s, readings[:40])
    np.testing.assert_array_equal(times, even_s)
    np.testing.assert_array_equal(means, readings[:40])


@given(st.sampled_from((4.0, 40.0, 500.0)), st.lists(st.integers(1, 60), min_size=1), st.integers(0, 2**32 - 1))
def test_frames_of_a_stream_do_not_depend_on_how_it_is_cut(rate_hz: float, lengths: list[int], seed: int) -> None:
    times_s, readings = uneven(rate_hz, seed)
    whole, stream, parts, begin = FrameStream(rate_hz, 2).feed(times_s, readings), FrameStream(rate_hz, 2), [], 0
    for length in [*lengths, len(times_s)]:
        parts.append(stream.feed(times_s[begin : begin + length], readings[begin : begin + length]))
        begin += length
    for part, expected in zip(map(np.concatenate, zip(*parts, strict=True)), whole, strict=True):
        np.testing.assert_allclose(part, expected, atol=1e-9)
    assert len(whole[0]) == pytest.approx((times_s[-1] - times_s[0]) / FRAME_S, abs=1.5 + 1.5 / (rate_hz * FRAME_S))


def test_a_night_without_readings_makes_few_frames() -> None:
    """In a recording and in a stream; their times are those of the clock."""
    times_s = np.arange(2000) / 100 + np.repeat([0.0, 1e9], 1000)
    readings = np.repeat([[0.0], [1.0]], 1000, axis=0)
    frames = framed(Recording(readings, times_s, np.zeros((2, 2)), np.array([300, 1300]), np.array([500, 1500])))
    stream = FrameStream(100.0, 1)
    parts = [stream.feed(times_s[i : i + 7], readings[i : i + 7]) for i in range(0, 2000, 7)]
    for found_s, values in ((frames.times_s, frames.readings), map(np.concatenate, zip(*parts, strict=True))):
        assert (np.diff(found_s) > 0).all()
        assert len(found_s) == pytest.approx(21 / FRAME_S, abs=3)
        np.testing.assert_array_equal(values[found_s < 10], 0)
        np.testing.assert_allclose(values[found_s > 1e9 + 10], 1)
    np.testing.assert_allclose(frames.times_s[frames.down_command], times_s[[300, 1300]], atol=FRAME_S)


def test_more_readings_of_the_same_locate_alike(localizer: LocalizerModel, brief: Recording) -> None:
    once, often = repeated(brief, 1), repeated(brief, 6)
    at_once, at_often = localizer.predict(once), localizer.predict(often)
    np.testing.assert_allclose(at_often.positions_mm, at_once.positions_mm, atol=1e-4)
    np.testing.assert_allclose(at_often.r90_mm, at_once.r90_mm, atol=1e-4)
    errors = [errors_by_moment(localizer, each, np.arange(9), (0,), ignore_progress) for each in (once, often)]
    at_once, at_often = ([[row["time_s"], row["mean_mm"]] for row in each["by_moment"]] for each in errors)
    np.testing.assert_allclose(at_often, at_once, atol=1e-4)


def test_live_averages_a_faster_stream(localizer: LocalizerModel, recording: Recording) -> None:
    def estimates(times: int) -> np.ndarray:
        stream = repeated(recording, times)
        live = Live(localizer, rate_hz=stream.rate_hz)
        end = int(stream.down_command[6])
        found = [e for e in live.update(stream.times_s[:end], stream.readings[:end]) if isinstance(e, Estimate)]
        return np.array([(e.press, e.since == "lift", e.readings, e.final, e.x_mm, e.y_mm, e.r90_mm) for e in found])

    once, often = estimates(1), estimates(6)
    assert len(once) > 100
    assert len(once) - len(often) <= 1  # the last frame is not complete
    np.testing.assert_allclose(often, once[: len(often)], rtol=0, atol=1e-4)
