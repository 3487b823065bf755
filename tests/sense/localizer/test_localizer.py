"""The network and the localizer: NumPy says what torch says, masks hide, files keep every bit."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from design.common.errors import InputError
from sense import Localizer, Recording
from sense import settings as sense_settings
from sense.health.trained_model import one_cycle
from sense.localizer import network
from sense.localizer.calibration import training
from sense.localizer.calibration.training import draw_alive, looked_up
from sense.localizer.features import Inputs
from sense.localizer.network import pooled
from sense.localizer.normalization import Normalization, Scaled


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), layers=st.integers(1, 4))
def test_numpy_and_torch_agree(seed: int, layers: int) -> None:
    options = sense_settings.LocalizerSettings(layers=layers, hidden=24)
    generator = torch.Generator().manual_seed(seed)
    weights = training.initial(3 * 5 + 3, options, generator)
    inputs = torch.randn(7, 3, 5, generator=generator)
    alive = torch.rand(7, 3, generator=generator) < 0.6
    expected = training.forward(weights, training.masked(inputs, alive)[None]).detach().numpy()
    plain = {name: weight.detach().numpy() for name, weight in weights.items()}
    found = network.forward(plain, network.masked(inputs.numpy(), alive.numpy()))
    assert found.dtype == np.float32
    assert np.allclose(found, expected, atol=2e-5)


@given(fibres=st.integers(1, 9), lost=st.integers(0, 4), seed=st.integers(0, 99))
def test_training_masks_lose_no_more_than_they_may(fibres: int, lost: int, seed: int) -> None:
    lost = min(lost, fibres - 1)
    alive = draw_alive(800, fibres, lost, torch.Generator().manual_seed(seed))
    gone = (~alive).sum(dim=1)
    assert gone.max() <= lost
    assert set(gone.unique().tolist()) == set(range(lost + 1))


@given(seed=st.integers(0, 999), x=st.floats(-1, 1), y=st.floats(-1, 1))
def test_a_table_is_looked_up_between_its_entries(seed: int, x: float, y: float) -> None:
    """Against a bilinear function, which linear interpolation gives exactly."""
    a, b, c, d = np.random.default_rng(seed).standard_normal(4)
    grid = np.linspace(-1, 1, 9)
    u, v = np.meshgrid(grid, grid, indexing="ij")
    table = torch.from_numpy((a + b * u + c * v + d * u * v)[:, :, None])
    found = looked_up(table, torch.tensor([[x, y]], dtype=torch.float64))
    assert found.item() == pytest.approx(a + b * x + c * y + d * x * y, abs=2e-3)


def test_the_spread_of_members_adds_to_what_they_expect() -> None:
    outputs = np.zeros((2, 1, 4), dtype=np.float32)
    outputs[:, 0, 0] = [-0.3, 0.5]
    outputs[:, 0, 2:] = np.log(0.2)
    place, sd = pooled(outputs)
    assert place[0].tolist() == pytest.approx([0.1, 0.0])
    assert sd[0].tolist() == pytest.approx([np.sqrt(2 * 0.04 + 0.16), np.sqrt(2 * 0.04)])


def test_the_rate_rises_once_and_ends_at_nothing() -> None:
    rates = np.array([one_cycle(share) for share in np.linspace(0, 1, 101)])
    assert rates.max() == 1
    assert rates[-1] == pytest.approx(0)
    peak = int(rates.argmax())
    assert (np.diff(rates[: peak + 1]) > 0).all()
    assert (np.diff(rates[peak:]) < 0).all()


@pytest.mark.parametrize(("share", "rate"), [(0.05, 0.25), (0.1, 0.5), (0.2, 1.0), (0.4, 0.8535533906), (0.6, 0.5)])
def test_the_rate_rises_along_a_line_and_falls_along_a_cosine(share: float, rate: float) -> None:
    assert one_cycle(share) == pytest.approx(rate)


def test_presses_moved_over_the_edge_are_sent_back_by_as_much(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of presses at the corners of the known places, half of a normal distribution remains on either axis."""
    corners = np.array([[-0.5, -0.6], [-0.5, 0.6], [0.5, -0.6], [0.5, 0.6]], dtype=np.float32)
    samples = training.TrainingPresses(np.zeros((4, 1, 1), np.float32), np.ones((4, 1), bool), corners)
    seen: list[torch.Tensor] = []

    def spy(table: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
        seen.append(places)
        return looked_up(table, places)

    monkeypatch.setattr(training, "looked_up", spy)
    options = sense_settings.LocalizerSettings(hidden=8, layers=1, lost=0)
    member = training._Member(samples, samples, np.zeros((3, 3, 1, 1), np.float32), options, 0)
    for _ in range(500):
        member._loss()
    inwards = np.abs(corners[0]) - torch.cat(seen[1:]).abs().cpu().numpy()
    assert inwards.min() >= -1e-6
    assert np.sqrt(np.square(inwards).mean(axis=0)) == pytest.approx([training.MOVED] * 2, rel=0.06)


def test_a_masked_fibre_changes_nothing(localizer: Localizer, recording: Recording) -> None:
    presses = localizer.inputs(recording)
    spoilt = presses.inputs.copy()
    spoilt[:, 1] = np.nan
    masked = localizer.locate(presses, [1])
    assert np.array_equal(localizer.locate(Scaled(spoilt, presses.alive), [1]).places_mm, masked.places_mm)
    assert not np.array_equal(masked.places_mm, localizer.locate(presses).places_mm)


def test_a_fibre_that_gave_no_readings_is_as_good_as_masked(localizer: Localizer, recording: Recording) -> None:
    readings = np.array(recording.readings)
    readings[:, 1] = np.nan
    found = localizer.locate(localizer.inputs(replace(recording, readings=readings)))
    expected = localizer.locate(localizer.inputs(recording), [1])
    assert np.array_equal(found.places_mm, expected.places_mm)
    assert np.array_equal(found.r90_mm, expected.r90_mm)


def test_a_press_without_any_fibre_may_be_anywhere(localizer: Localizer, recording: Recording) -> None:
    readings = np.array(recording.readings)
    readings[recording.begun[7] - 15 : recording.lifted[7] + 25] = np.nan
    found = localizer.locate(localizer.inputs(replace(recording, readings=readings)))
    assert found.places_mm[7] == pytest.approx(localizer.normalization.middle_mm)
    assert found.r50_mm[7] < found.r90_mm[7]
    assert found.r50_mm[7] > 0.5 * localizer.normalization.span_mm
    assert np.isfinite(found.places_mm).all()


def test_the_radii_of_a_press_anywhere_hold_what_they_say() -> None:
    from sense.localizer.localizer import UNKNOWN

    far = np.hypot(*np.random.default_rng(0).uniform(-1, 1, (2, 200_000)))
    assert np.mean(far <= UNKNOWN[1]) == pytest.approx(0.5, abs=0.005)
    assert np.mean(far <= UNKNOWN[2]) == pytest.approx(0.9, abs=0.005)


def test_a_press_is_located_alone_as_among_others(localizer: Localizer, recording: Recording) -> None:
    presses = localizer.inputs(recording)
    found = localizer.locate(presses)
    assert np.allclose(localizer.locate(presses[17:18]).places_mm, found.places_mm[17:18], atol=1e-4)
    assert localizer.locate(presses[:0]).places_mm.shape == (0, 2)


def test_less_is_known_with_fibres_lost(localizer: Localizer, recording: Recording) -> None:
    presses = localizer.inputs(recording)
    means = [localizer.locate(presses, range(lost)).r90_mm.mean() for lost in range(4)]
    assert means == sorted(means)
    found = localizer.locate(presses)
    assert (found.r50_mm < found.r90_mm).all()
    assert (found.sd_mm > 0).all()


@pytest.mark.parametrize(
    ("lost", "message"),
    [
        ([4], "lost fibre at index 4: none, allowed are 0 to 3"),
        ([-1], "lost fibre at index -1"),
        ([0, 1, 2, 3], "all 4 fibres"),
    ],
)
def test_masks_that_cannot_be_are_refused(
    localizer: Localizer, recording: Recording, lost: list[int], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        localizer.locate(localizer.inputs(recording), lost)


def test_files_keep_every_bit(localizer: Localizer, recording: Recording, tmp_path: Path) -> None:
    localizer.save(tmp_path)
    found = Localizer.load(tmp_path)
    assert all(np.array_equal(found.weights[name], weight) for name, weight in localizer.weights.items())
    presses = localizer.inputs(recording)
    assert np.array_equal(found.inputs(recording).inputs, presses.inputs)
    again, before = found.locate(presses, [2]), localizer.locate(presses, [2])
    assert np.array_equal(again.places_mm, before.places_mm)
    assert np.array_equal(again.r90_mm, before.r90_mm)
    assert found.errors == localizer.errors
    assert found.test == localizer.test
    found.save(tmp_path / "again")
    for name in ("localizer.json", "localizer.safetensors"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / name).read_bytes()


def test_files_that_do_not_belong_together_are_refused(localizer: Localizer, tmp_path: Path) -> None:
    localizer.save(tmp_path)
    weights = tmp_path / "localizer.safetensors"
    weights.write_bytes(weights.read_bytes()[:-4])
    with pytest.raises(InputError, match=r"not the weights that localizer\.json was written with"):
        Localizer.load(tmp_path)
    weights.unlink()
    with pytest.raises(InputError, match="cannot be read"):
        Localizer.load(tmp_path)


@pytest.mark.parametrize(("key", "value"), [("features", "smell"), ("scaling", {}), ("rate_hz", None)])
def test_a_document_that_is_no_localizer_is_refused(
    localizer: Localizer, tmp_path: Path, key: str, value: object
) -> None:
    localizer.save(tmp_path)
    document = json.loads((tmp_path / "localizer.json").read_text())
    (tmp_path / "localizer.json").write_text(json.dumps(document | {key: value}))
    with pytest.raises(InputError, match=r"localizer\.json"):
        Localizer.load(tmp_path)


def test_recordings_that_do_not_suit_are_refused(localizer: Localizer, recording: Recording) -> None:
    fewer = Recording(
        recording.readings[:, :3], recording.times_s, recording.presses_mm, recording.begun, recording.lifted
    )
    with pytest.raises(InputError, match="3 fibres, the localizer was learnt from 4"):
        localizer.inputs(fewer)
    faster = Recording(
        recording.readings, recording.times_s / 2, recording.presses_mm, recording.begun, recording.lifted
    )
    with pytest.raises(InputError, match="readings a second"):
        localizer.inputs(faster)


@pytest.mark.parametrize(("ratio", "suits"), [(0.74, False), (0.76, True), (1.24, True), (1.26, False)])
def test_a_recording_is_up_to_a_quarter_faster_or_slower(
    localizer: Localizer, recording: Recording, ratio: float, suits: bool
) -> None:
    other = replace(recording, times_s=recording.times_s / ratio)
    if suits:
        assert np.isfinite(localizer.locate(localizer.inputs(other)).places_mm).all()
    else:
        with pytest.raises(InputError, match="readings a second"):
            localizer.inputs(other)


def raw(windows: np.ndarray, history: np.ndarray | None = None) -> Inputs:
    past = np.zeros((*windows.shape[:2], 0)) if history is None else history
    return Inputs(windows, past, np.ones(windows.shape[:2], dtype=bool))


@settings(max_examples=6)  # each fits the whole pad twice
@given(seed=st.integers(0, 999), gain=st.floats(1e-3, 1e3))
def test_scaled_inputs_do_not_depend_on_the_gain(seed: int, gain: float) -> None:
    rng = np.random.default_rng(seed)
    inputs, places = rng.standard_normal((30, 3, 4)), rng.uniform(-9, 9, (30, 2))
    (plain, table), (scaled, same) = (Normalization.fit(raw(factor * inputs), places) for factor in (1, gain))
    assert np.allclose(plain.inputs(raw(inputs)).inputs, scaled.inputs(raw(gain * inputs)).inputs, atol=1e-4)
    assert np.allclose(table, same, atol=1e-3)
    assert np.abs(plain.targets(places)).max() <= 1 + 1e-6
    assert np.allclose(plain.places_mm(plain.targets(places)), places, atol=1e-5)


def test_a_dead_fibre_is_scaled_to_finite_numbers() -> None:
    inputs = np.zeros((10, 2, 3))
    inputs[:, 0] = np.random.default_rng(0).standard_normal((10, 3))
    assert np.isfinite(Normalization.fit(raw(inputs), np.zeros((10, 2)))[0].inputs(raw(inputs)).inputs).all()


def test_a_fibre_that_was_never_there_is_scaled_to_finite_numbers() -> None:
    rng = np.random.default_rng(0)
    inputs = replace(raw(rng.standard_normal((10, 2, 3))), alive=np.tile([True, False], (10, 1)))
    scaling, table = Normalization.fit(inputs, rng.uniform(-9, 9, (10, 2)))
    assert np.isfinite(scaling.inputs(inputs).inputs).all()
    assert np.isfinite(table).all()


def edited(document: dict, path: str, value: object) -> dict:
    """`document` with the entry at `path`, keys and indices with dots between them, replaced."""
    *way, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    place = document
    for part in way:
        place = place[part]
    place[last] = value
    return document


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        ("features", "smell", "features"),
        ("features", "published", r"scaling\.centre_v"),
        ("fibres", 3, r"scaling\.centre_v"),
        ("fibres", 0, "fibres"),
        ("fibres", True, "fibres"),
        ("method", "guess", "method"),
        ("method", "published", "features"),
        ("factors", [], "factors"),
        ("factors.0", [1.0, 1.0], "factors"),
        ("factors.0.0", -1.0, "factors"),
        ("scaling.memory", [], r"scaling\.memory"),
        ("scaling.memory.0.0", [1.0], r"scaling\.memory"),
        ("scaling.memory.0.0.0", np.nan, "memory"),
        ("scaling.usual_v.0", [1.0], r"scaling\.usual_v"),
        *(("rate_hz", value, "rate_hz") for value in (0, -1.0, "13", np.nan, np.inf, 1e-300, None)),
        *(
            (f"scaling.{key}.0.0", value, key)
            for key in ("centre_v", "spread_v")
            for value in (np.nan, np.inf, 1e9, "1")
        ),
        ("scaling.spread_v.0.0", 0.0, "spread_v"),
        ("scaling.spread_v.0", [1.0], "spread_v"),
        ("scaling.centre_v", [], "centre_v"),
        *(("scaling.middle_mm", value, "middle_mm") for value in ([0.0], [0.0, np.nan], [1e9, 0.0], 3, None)),
        *(("scaling.span_mm", value, "span_mm") for value in (0.0, -1.0, np.nan, np.inf, 1e30, "9")),
        ("split", "alphabetical", "split"),
        *(("test", value, "test") for value in ([], [0.5], ["a"], [-1], [True], {}, [3, 3], [7])),
        ("errors", [{}], r"errors\.0\.lost"),
        ("errors", "none", "errors"),
        ("learnt_from", 7, "learnt_from"),
        ("provenance", [], "provenance"),
        ("more", 1, "more"),
    ],
)
def test_a_document_with_a_value_out_of_bounds_is_refused(
    localizer: Localizer, tmp_path: Path, path: str, value: object, named: str
) -> None:
    localizer.save(tmp_path)
    document = edited(json.loads((tmp_path / "localizer.json").read_text()), path, value)
    (tmp_path / "localizer.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=rf"localizer\.json: .*{named}") as caught:
        Localizer.load(tmp_path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    "change",
    [
        lambda w: {**w, "last.b": w["last.b"] * np.float32(np.nan)},
        lambda w: {**w, "first.w": w["first.w"] + np.float32(1e30)},
        lambda w: {**w, "first.w": w["first.w"][:, 1:]},
        lambda w: {**w, "first.w": w["first.w"][:0]},
        lambda w: {**w, "hidden.b": w["hidden.b"].astype(np.float64)},
        lambda w: {name: weight for name, weight in w.items() if name != "last.w"},
        lambda w: {},
    ],
)
def test_weights_that_do_not_fit_the_document_are_refused(localizer: Localizer, tmp_path: Path, change) -> None:
    replace(localizer, weights=change(dict(localizer.weights))).save(tmp_path)
    with pytest.raises(InputError, match=r"localizer\.safetensors: no weights of the localizer"):
        Localizer.load(tmp_path)


@pytest.mark.parametrize("value", [np.nan, object()])
def test_a_save_that_fails_leaves_the_model_that_was_there(localizer: Localizer, tmp_path: Path, value: object) -> None:
    localizer.save(tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    other = {name: weight + 1 for name, weight in localizer.weights.items()}
    with pytest.raises(InputError, match="cannot be written as JSON"):
        replace(localizer, weights=other, provenance={"note": value}).save(tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_save_into_a_place_that_is_taken_changes_nothing(localizer: Localizer, tmp_path: Path) -> None:
    localizer.save(tmp_path)
    (tmp_path / "localizer.json").unlink()
    (tmp_path / "localizer.json").mkdir()
    before = (tmp_path / "localizer.safetensors").read_bytes()
    with pytest.raises(InputError, match="cannot be written"):
        replace(localizer, weights={name: weight + 1 for name, weight in localizer.weights.items()}).save(tmp_path)
    assert (tmp_path / "localizer.safetensors").read_bytes() == before
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        localizer.save(tmp_path / "file")


@pytest.mark.parametrize("lost", [[10**20], [0.5], [True], ["a"]])
def test_a_mask_that_is_no_index_is_refused(localizer: Localizer, recording: Recording, lost: list) -> None:
    with pytest.raises(InputError, match=r"lost fibre at index .*: none, allowed are 0 to 3"):
        localizer.locate(localizer.inputs(recording), lost)


def test_readings_far_from_all_learnt_ones_give_finite_places(localizer: Localizer, recording: Recording) -> None:
    readings = 1000.0 * np.random.default_rng(0).choice([-1, 1], recording.readings.shape)
    spread = np.full_like(localizer.normalization.spread, 1e-40)
    still = replace(localizer.normalization, spread=spread, middle_mm=np.zeros(2), span_mm=1e5)
    found = replace(localizer, normalization=still)
    places = found.locate(found.inputs(replace(recording, readings=readings)))
    assert np.isfinite(places.places_mm).all()
    assert np.isfinite(places.r90_mm).all()


def test_a_fibre_that_varies_by_rounding_only_is_not_blown_up() -> None:
    inputs = 3.3 + 1e-15 * np.random.default_rng(0).standard_normal((10, 2, 3))
    scaling, _ = Normalization.fit(raw(inputs), np.zeros((10, 2)))
    assert (scaling.spread == 1).all()
