"""Models, results and unfinished studies, spoiled: what loads finds places and faults, or one line says why not."""

import hashlib
import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given

import padforge
import sense
from tests.helpers.effort import few
from tests.stress.sense.cases import TINY, learnt, made, recorded, right_or_refused, seeds, watched
from tests.stress.sense.spoiling import SMALL, dumped, edited, files_of, flipped, put, run_directory


@cache
def model_files(tmp: Path) -> dict[str, bytes]:
    learnt().save(tmp / "model")
    watched().save(tmp / "model")
    return files_of(tmp / "model")


def rewritten(rng: np.random.Generator, files: dict[str, bytes], name: str) -> None:
    """Spoil arrays of NAME.safetensors and put the digest of the new file into NAME.json, as a forger would."""
    arrays = safetensors.numpy.load(files[f"{name}.safetensors"])
    key = list(arrays)[rng.integers(len(arrays))]
    array, kind = arrays[key].copy(), rng.integers(5)
    if kind == 0:
        array.ravel()[rng.integers(array.size)] = rng.choice([np.nan, np.inf, 1e30, 0.0, -1.0])
    elif kind == 1:
        array = array.astype(rng.choice(["f2", "f4", "f8", "i4", "u1", "?"]))
    elif kind == 2:
        array = array[..., :-1] if array.ndim else array
    elif kind == 3:
        array = array * rng.choice([0.0, 1e30, -1.0, 1e-30])
    else:
        array = np.zeros((0, *array.shape))
    arrays[key] = np.ascontiguousarray(array)
    if rng.random() < 0.1:
        del arrays[key]
    content = safetensors.numpy.save(arrays)
    if rng.random() < 0.3:
        content = flipped(rng, content)
    document = json.loads(files[f"{name}.json"])
    document["weights_sha256"] = hashlib.sha256(content).hexdigest()
    files |= {f"{name}.safetensors": content, f"{name}.json": dumped(document)}


@few(40)
@given(seed=seeds)
def test_a_model_that_loads_finds_places_and_faults(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, folder = np.random.default_rng(seed), tmp_path_factory.getbasetemp() / "spoiled"
    files = dict(model_files(tmp_path_factory.getbasetemp()))
    name = ["localizer", "health"][rng.integers(2)]
    kind = rng.integers(4)
    if kind == 0:
        part = f"{name}.{rng.choice(['json', 'safetensors'])}"
        files[part] = flipped(rng, files[part])
    elif kind == 1:
        del files[f"{name}.{rng.choice(['json', 'safetensors'])}"]
    elif kind == 2:
        files[f"{name}.json"] = dumped(edited(rng, json.loads(files[f"{name}.json"])))
    else:
        with np.errstate(all="ignore"):
            rewritten(rng, files, name)
    put(folder, files)
    if name == "localizer":
        localizer = right_or_refused(lambda: sense.Localizer.load(folder))
        if localizer is not None:
            found = right_or_refused(lambda: sense.locate(localizer, SMALL))
            assert found is None or np.isfinite(np.column_stack([found.places_mm, found.r50_mm, found.r90_mm])).all()
            right_or_refused(lambda: sense.evaluate(localizer, recorded(), (0,)))
            right_or_refused(lambda: localizer.save(folder))
        return
    health = right_or_refused(lambda: sense.HealthModel.load(folder))
    if health is not None:
        edges = SMALL.begun, SMALL.lifted
        for finding in right_or_refused(lambda: sense.examine(health, SMALL.readings, SMALL.times_s, *edges)) or ():
            assert 0 <= finding.since <= finding.press < 12


@cache
def results(tmp: Path) -> dict[str, bytes]:
    """The documents of a calibration and of a study of lost fibres, and a start of a recording."""
    _, document = sense.calibrate(made(4, presses=40), TINY)
    studied = sense.fibre_loss_study(SMALL, learnt(), lost=2)
    study = {"format": "padforge-study-x/1", "title": "A", "text": ["b"], "rows": [{"a": 1, "b": 2.5}]}
    study |= {"provenance": document["provenance"]}
    named = {"calibration.json": document, "fibre_loss.json": studied, "x.json": study}
    return {name: dumped(content) for name, content in named.items()} | {"start.json": run_directory(tmp)["start.json"]}


@few(60)
@given(seed=seeds)
def test_reports_of_spoiled_results(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, tmp = np.random.default_rng(seed), tmp_path_factory.getbasetemp()
    files = dict(results(tmp))
    name = list(files)[rng.integers(len(files))]
    files[name] = flipped(rng, files[name]) if rng.random() < 0.3 else dumped(edited(rng, json.loads(files[name])))
    start = files.pop("start.json")
    folder = put(tmp / "pad", files)
    put(folder / "recording", {"start.json": start})
    page = right_or_refused(lambda: padforge.write_report(folder))
    assert (page is not None and "</html>" in page.read_text("utf-8")) or not (folder / "report.html").exists()


@few(20)
@given(seed=seeds)
def test_a_study_resumes_from_sound_networks_only(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    """A robustness study that was broken off goes on from what it kept, or says what is wrong with it."""
    rng, tmp = np.random.default_rng(seed), tmp_path_factory.getbasetemp()
    files = unfinished(tmp)
    spoiled = dict(files)
    name = list(files)[rng.integers(len(files))]
    if rng.random() < 0.7:
        spoiled[name] = flipped(rng, files[name])
    else:
        spoiled[f"start_{rng.choice(['9999', 'x', '-1', '0000_1', ''])}.npz"] = files[name]
    folder = put(tmp / "unfinished", spoiled)
    retrained = {"retrain": True, "options": TINY, "lost": 0}
    found = right_or_refused(lambda: sense.fibre_loss_study(made(5, presses=60), keep_in=folder, **retrained))
    if found is not None:
        assert all(np.isfinite(row["mean_mm"]) for row in found["ways"]["retrained"]["errors"])


@cache
def unfinished(tmp: Path) -> dict[str, bytes]:
    """What a study of lost fibres leaves that is broken off after its first network."""

    def stop(done: int, of: int) -> None:
        if done:
            raise KeyboardInterrupt

    folder, options = tmp / "kept", {"retrain": True, "options": TINY, "lost": 0}
    with pytest.raises(KeyboardInterrupt):
        sense.fibre_loss_study(made(5, presses=60), keep_in=folder, progress=stop, **options)
    return files_of(folder)
