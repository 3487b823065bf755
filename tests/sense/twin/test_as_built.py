"""The parametric model of a pad, the search for its wiring, and its fits to responses and parts of presses."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from padforge.design import Contact, Morphology, signals
from padforge.design.layer import Base
from padforge.design.twin import PlanTransform
from padforge.sense import Recording, RigSettings, simulate
from padforge.sense.localizer.features import PressFeatures
from padforge.sense.simulation.built_pad import build_pad
from padforge.sense.simulation.pad_model import SUPPLY_V, Cycle, resistance_changes
from padforge.sense.twin import as_built, press_parts
from padforge.sense.twin.as_built import N_SHARED, OFFSET, SENSITIVITY, AsBuiltPad, PadPlan
from padforge.sense.twin.contact_fit import fit_contact
from padforge.sense.twin.fitting import Priors, estimate_scatter, fit_as_built, gain_wander
from padforge.sense.twin.press_parts import SeparatedPresses, part_kernels, separate_parts
from padforge.sense.twin.responses import Responses, select_one_depth
from padforge.sense.twin.wiring import Wiring, images, planned_paths_mm
from tests.sense.conftest import first_presses

from .conftest import PLAN, simulate_responses

POSITIONS_MM = np.random.default_rng(2).uniform(-10, 10, (40, 2))


@pytest.fixture
def pad() -> AsBuiltPad:
    plan = PadPlan.from_morphology(PLAN)
    pad = AsBuiltPad.from_plan(plan, (2, 0, 3), PlanTransform(True, 4.0, (1.0, -2.0), 0.95), 0.5)
    return replace(pad, values=pad.values + 0.03 * np.random.default_rng(0).standard_normal(pad.values.size))


def test_jacobian_agrees_with_differences(pad):
    jacobians = pad.predict_with_jacobian(POSITIONS_MM)[1]
    steps = 1e-6 * np.eye(len(pad.values))
    for index in [*range(N_SHARED), *range(N_SHARED, len(pad.values), 11)]:
        step = steps[index]
        ahead, behind = (replace(pad, values=pad.values + sign * step).predict(POSITIONS_MM) for sign in (1, -1))
        slope = (ahead - behind) / 2e-6
        for channel in range(3):
            columns = np.concatenate([np.arange(N_SHARED), as_built.channel_indices(channel)])
            derivative = jacobians[channel][:, columns == index].sum(axis=1)
            assert slope[:, channel] == pytest.approx(derivative, abs=1e-6)


@pytest.mark.parametrize(
    ("fibres", "pitch_mm", "count"), [(3, 11.25, 8), ((2, 3), (8.0, 12.0), 4), ((2, 2), (8.0, 9.0), 4)]
)
def test_images_of_a_wiring_respond_alike_on_straight_fibres(fibres, pitch_mm, count) -> None:
    pad = Morphology.straight(fibres, pitch_mm)
    start = Wiring(PlanTransform(True, -97.0, (3.0, 1.0), 1.1), 0.5, tuple(range(len(pad.knots)))[::-1], 0.5)
    positions_mm = np.random.default_rng(0).uniform(-8, 8, (40, 2))
    wirings = [start, *images(start, pad.layout)]
    assert len({(wiring.transform.mirrored, wiring.fibres) for wiring in wirings}) == count
    expected, *others = (
        signals(pad, pad.to_grid(wiring.transform.to_plan(positions_mm)), Contact(model="profile"))[:, wiring.fibres]
        for wiring in wirings
    )
    for other in others:
        np.testing.assert_allclose(other, expected, atol=1e-9)
    plan = PadPlan.from_morphology(pad, 5)
    planned, *others = (planned_paths_mm(plan, wiring.transform, wiring.fibres) for wiring in wirings)
    for other in others:  # each from one end or the other
        same, reverse = np.abs(planned - other).max((1, 2)), np.abs(planned - other[:, ::-1]).max((1, 2))
        np.testing.assert_allclose(np.minimum(same, reverse), 0, atol=1e-9)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("turn_deg", [-180, 90])
def test_planned_paths_lie_under_the_arm_where_the_transform_takes_them_to_the_plan(mirrored, turn_deg) -> None:
    plan, fibres = PadPlan.from_morphology(PLAN, 5), (2, 0)
    expected = (plan.paths[[2, 0]] - np.array(plan.layout.extent) / 2) * plan.layout.unit_mm
    paths_mm = planned_paths_mm(plan, PlanTransform(mirrored, turn_deg + 8.0, (3.0, 1.0), 1.1), fibres)
    on_plan = [PlanTransform(mirrored, turn_deg).to_plan(path) for path in paths_mm]
    np.testing.assert_allclose(on_plan, expected, atol=1e-9)


def test_select_one_depth_keeps_the_most_common_and_all_of_unknown_depth() -> None:
    recording = simulate(
        Morphology.straight(2), RigSettings(presses=9, depths_mm=(0.5, 3.0, 5.0)), Contact(model="profile")
    )
    selected = select_one_depth(recording)
    assert selected.presses_mm[selected.has_position].tolist() == recording.presses_mm[2::3].tolist()
    unknown = replace(recording, depths_mm=np.full(9, np.nan))
    assert select_one_depth(unknown) is unknown
    assert select_one_depth(replace(recording, depths_mm=np.linspace(4.7, 5.3, 9))).has_position.all()


PAD = Morphology.random(2, knots=3, seed=5)
RIG = RigSettings(presses=500, seed=1, scatter=0.0, floor_mv=0.0, gain_wander=0.0, drift_mv=0.0, hysteresis_s=12.0)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return simulate(PAD, RIG)


@pytest.fixture(scope="module")
def split(recording: Recording) -> SeparatedPresses:
    return separate_parts(recording, np.arange(500) % 7 != 0, hysteresis_s=20.0)


def test_parts_memory_and_touch_are_those_that_were_simulated(recording: Recording, split: SeparatedPresses) -> None:
    depths_mm = np.full(500, RIG.press_depths_mm)
    changes = resistance_changes(build_pad(PAD, RIG), recording.presses_mm, depths_mm, Contact(), RIG)
    rest_v = np.median(recording.readings[:10], axis=0)
    slope_v = rest_v * (1 - rest_v / SUPPLY_V)  # by which a divider falls for a small change of resistance
    for part, change, share in zip(split.parts, changes, (0.97, 0.65, 0.7, 0.92), strict=True):
        expected = -slope_v * change
        # onset and creep are told the least: presses are touched at other times than one knows
        found = [np.corrcoef(part.volts[:, c], expected[:, c])[0, 1] for c in range(recording.fibres)]
        assert np.mean(found) > share
    slope = np.polyfit((-slope_v * changes.held).ravel(), split.parts.held.volts.ravel(), 1)[0]
    assert slope == pytest.approx(1, abs=0.12)
    assert split.rig["memory"] == pytest.approx(RIG.memory, abs=0.2)
    assert split.rig["memory_mm"] == pytest.approx(RIG.memory_mm, rel=0.35)
    assert split.rig["hysteresis_s"] == pytest.approx(RIG.hysteresis_s, rel=0.5)
    assert split.rig["touch_s"] == pytest.approx(RIG.touch_s, abs=0.015)
    # without what presses take away, neighbouring ones differ by half as much as they do with it
    x, y = recording.presses_mm.T
    order = np.argsort(np.round(x) * 1e3 + y)
    with_it = np.array(
        [
            recording.readings[d + 8 : d + 20].mean(0) - recording.readings[d - 8 : d].mean(0)
            for d in recording.down_command
        ]
    )
    near = np.hypot(*np.diff(recording.presses_mm[order], axis=0).T) < 1.5
    before, after = (np.diff(volts[order], axis=0)[near].std() for volts in (with_it, split.pressed.volts))
    assert after < 0.8 * before


def test_kernels_of_a_press() -> None:
    """It is held by its last windows, creeps meanwhile, and leaves what remains inverted; what it takes adds to it."""
    (held, onset, creep, after), replaced = part_kernels(Cycle(40, 13.3), RigSettings(hysteresis_s=1e4))
    assert held[6:9] == pytest.approx(1, abs=0.05)
    assert held[13:] == pytest.approx(0, abs=1e-9)
    assert onset[1] > held[1]
    assert np.all(np.diff(creep[2:9]) < 0)
    assert after[:9] == pytest.approx(0, abs=1e-9)
    assert after[12:] == pytest.approx(-1, abs=0.01)
    assert replaced[6:9] == pytest.approx(1, abs=0.01)
    assert replaced[12:] == pytest.approx(0.6, abs=0.01)


FREE = Priors(lateral_offset_mm=1.0, log_sensitivity=0.2)


@pytest.fixture(scope="module")
def start(printed):
    fibres = tuple(channel.fibre for channel in printed.channels if channel.fibre is not None)
    return AsBuiltPad.from_plan(PadPlan.from_morphology(PLAN), fibres, printed.frame, 0.5)


@pytest.fixture(scope="module")
def on_plan(start, responses):
    return fit_as_built(start, responses, Priors())


@pytest.fixture(scope="module")
def fitted(on_plan, responses):
    return fit_as_built(on_plan.pad, responses, FREE)


def test_fit_explains_fresh_presses_better_than_the_plan(printed, on_plan, fitted):
    fresh = simulate_responses(printed, 300, seed=1)
    explained, explained_on_plan = (
        fresh.explained_variance(fit.pad.predict(fresh.positions_mm)) for fit in (fitted, on_plan)
    )
    assert not on_plan.pad.channel_values[:, OFFSET].any()
    assert not on_plan.pad.channel_values[:, SENSITIVITY].any()
    assert not on_plan.pad.profile(np.linspace(0, 1, 9))[1].any()
    assert explained.min() > 0.97
    assert explained.mean() > explained_on_plan.mean()


def test_fit_recovers_lateral_offsets_unless_noise_is_inflated(printed, fitted, responses):
    errors, offsets, plan = [], [], fitted.pad.plan
    for channel, fibre in enumerate(fitted.pad.fibres):
        true = plan.to_grid(printed.as_built_mm[fibre])[1:-1]
        normal = plan.tangents[fibre] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        inside = (np.abs(plan.paths[fibre] - 1.5) < 1).all(axis=1)
        errors.append(((fitted.pad.path(channel)[0] - true) * normal).sum(axis=1)[inside])
        offsets.append(((plan.paths[fibre] - true) * normal).sum(axis=1)[inside])
    assert np.std(np.concatenate(errors)) < 0.7 * np.std(np.concatenate(offsets))
    # inflated noise shrinks offsets and widens their standard deviation
    inflated = fit_as_built(fitted.pad, responses, FREE, noise_inflation=20.0)
    small, large = (np.square(fit.pad.channel_values[:, OFFSET]).sum() for fit in (inflated, fitted))
    assert small < large
    assert inflated.offset_std(0).mean() > fitted.offset_std(0).mean()


@pytest.mark.parametrize(("share", "common", "floor"), [(0.0, 0.0, 0.01), (0.18, 0.36, 0.01), (0.18, 0.9, 0.002)])
def test_estimate_scatter_recovers_share_common_and_floor(printed, fitted, share, common, floor) -> None:
    noiseless = replace(printed, channels=tuple(replace(channel, noise_v=0.0) for channel in printed.channels))
    exact = simulate_responses(noiseless, 900)
    rng, full_scale = np.random.default_rng(4), np.abs(exact.volts).max()
    independent, shared = rng.standard_normal(exact.volts.shape), rng.standard_normal((len(exact), 1))
    gain = 1 + share * (np.sqrt(1 - common) * independent + np.sqrt(common) * shared)
    volts = exact.volts * gain + floor * full_scale * rng.standard_normal(exact.volts.shape)
    noise_v = (volts - exact.volts).std(axis=0)
    scatter = estimate_scatter(fitted.pad, Responses(exact.positions_mm, volts, exact.valid), noise_v)
    assert scatter.share == pytest.approx(share, abs=0.03)
    # a floor far below what grows is hidden by it, but never mistaken for much
    assert scatter.floor * noise_v.mean() == pytest.approx(floor * full_scale, rel=0.35, abs=0.25 * noise_v.mean())
    if share:
        assert scatter.common == pytest.approx(common, abs=0.15)


def test_gains_wander_by_their_deviation_between_blocks_beyond_chance(pad: AsBuiltPad) -> None:
    """Of 0.9, 1 and 1.1; and of noise alone, of which nothing is left."""
    positions_mm, rest = np.tile(POSITIONS_MM, (20, 1))[:750], pad.channel_values[:, 1]
    responses = pad.predict(positions_mm) - rest
    volts, all_valid = rest + np.repeat([0.9, 1.0, 1.1], 250)[:, None] * responses, np.ones(responses.shape, bool)
    assert gain_wander(pad, Responses(positions_mm, volts, all_valid)) == pytest.approx(0.1)
    noise = 0.3 * responses.std() * np.random.default_rng(0).standard_normal(responses.shape)
    assert gain_wander(pad, Responses(positions_mm, rest + responses + noise, all_valid)) < 0.015
    assert gain_wander(pad, Responses(positions_mm, volts, all_valid).select(np.arange(499))) == 0


def test_parts_learn_nothing_from_what_presses_held_out_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """But for the time of the touch, which is no part, and those presses' own parts."""
    first = first_presses(simulate(PAD, RIG.model_copy(update={"presses": 160})), 150)
    training = np.arange(150) % 5 != 0
    plain, compute = separate_parts(first, training, 20.0), press_parts.compute_features

    def spoil(readings: np.ndarray, *commands: Any) -> PressFeatures:
        features = compute(readings, *commands)
        if len(features) == len(training):  # not those of kernels
            features.windows[~training] = 99.0
        return features

    monkeypatch.setattr(press_parts, "compute_features", spoil)
    spoilt = separate_parts(first, training, 20.0)
    for part, other in zip((*plain.parts, plain.pressed), (*spoilt.parts, spoilt.pressed), strict=True):
        np.testing.assert_array_equal(other.volts[training], part.volts[training])
        assert not np.array_equal(other.volts, part.volts)
    assert spoilt.rig | {"touch_s": 0} == plain.rig | {"touch_s": 0}


def press(contact: Contact, transform: PlanTransform, presses: int) -> Responses:
    positions_mm = np.random.default_rng(0).uniform(-14, 14, (presses, 2))
    volts = 0.3 - 0.5 * signals(PLAN, PLAN.to_grid(transform.to_plan(positions_mm)), contact)
    return Responses(positions_mm, volts, np.random.default_rng(1).uniform(size=volts.shape) < 0.95)


@pytest.mark.parametrize("base", ["bonded", "slipping"])
def test_fit_contact_recovers_scale_and_shares(base: Base) -> None:
    stated = Contact(base=base)
    pressed = Contact(base=base, scale=1.15, squeeze=0.7, stretch=1.3)
    responses = press(pressed, PlanTransform(True, 3.0, (1.0, -0.5), 1.02), 100)
    training, held_out = responses.select(np.arange(70)), responses.select(np.arange(70, 100))
    pad = AsBuiltPad.from_plan(PadPlan.from_morphology(PLAN), (0, 1, 2, 3), PlanTransform(True), 0.5)
    noise_v = 0.05 * np.sqrt(training.variance)
    fit = fit_contact(pad, stated, training, held_out, noise_v)
    assert fit.scale == pytest.approx(1.15, abs=0.03)
    assert (fit.squeeze, fit.stretch) == pytest.approx((0.7, 1.3), abs=0.1)
    assert fit.explained > 0.995
    assert 0 < fit.scale_std < 0.1 > fit.shares_std > 0
    gaussian = fit_contact(pad, Contact(model="profile"), training, held_out, noise_v)
    assert gaussian.explained < fit.explained
    assert gaussian.shares_std == 0


def test_fit_contact_states_shares_of_the_sum_that_was_stated() -> None:
    """Gains take up any other: twice the squeeze and stretch are twice the results, and as uncertain as a share.

    A layer half as large is the same at twice the scale, which is twice as uncertain.
    """
    responses = press(Contact(squeeze=0.7, stretch=1.3), PlanTransform(), 24)
    pad = AsBuiltPad.from_plan(PadPlan.from_morphology(PLAN), (0, 1, 2, 3), PlanTransform(), 0.5)
    noise_v = 0.05 * np.sqrt(responses.variance)
    single, double = (
        fit_contact(pad, Contact(squeeze=share, stretch=share), responses, responses, noise_v) for share in (0.5, 1.0)
    )
    for name in ("squeeze", "stretch", "shares_std"):
        assert getattr(double, name) == pytest.approx(2 * getattr(single, name), rel=1e-3)
    assert (double.scale, double.scale_std) == pytest.approx((single.scale, single.scale_std), rel=1e-3)
    sizes = {name: getattr(Contact(), name) / 2 for name in ("tool_radius_mm", "depth_mm", "thickness_mm")}
    first_mm, second_mm = Contact().fibre_depths_mm
    halved = Contact(**sizes, fibre_depths_mm=(first_mm / 2, second_mm / 2), scale=2.0)
    small = fit_contact(pad, halved, responses, responses, noise_v)
    assert small.scale == pytest.approx(2 * double.scale, rel=1e-3)
    assert small.scale_std == pytest.approx(2 * double.scale_std, rel=0.05)


def test_fit_contact_scatters_as_it_states() -> None:
    quiet, rng, fits = press(Contact(), PlanTransform(), 24), np.random.default_rng(3), []
    pad = AsBuiltPad.from_plan(PadPlan.from_morphology(PLAN), (0, 1, 2, 3), PlanTransform(), 0.5)
    noise_v = 0.05 * np.sqrt(quiet.variance)
    for _ in range(16):
        noisy = replace(quiet, volts=quiet.volts + noise_v * rng.standard_normal(quiet.volts.shape))
        fits.append(fit_contact(pad, Contact(), noisy, quiet, noise_v))
    for name, stated in ("scale", "scale_std"), ("squeeze", "shares_std"), ("stretch", "shares_std"):
        measured = np.std([getattr(fit, name) for fit in fits], ddof=1)
        assert 0.65 < measured / np.mean([getattr(fit, stated) for fit in fits]) < 1.5


def test_elements_of_a_pad_sum_to_its_lengths_and_follow_its_offsets() -> None:
    plan = PadPlan.from_morphology(PLAN)
    pad = AsBuiltPad.from_plan(plan, (2, 0), PlanTransform(), 0.5)
    middles, lengths, tangents = pad.elements(0)
    assert lengths == pytest.approx(plan.lengths[2])
    assert tangents == pytest.approx(plan.tangents[2])
    pad = pad.with_values(pad.values + 0.05 * np.random.default_rng(0).standard_normal(pad.values.size))
    middles, weighted, tangents = pad.elements(0)
    steps = np.gradient(middles, axis=0)[1:-1]
    lengths = np.hypot(*steps.T)
    assert tangents[1:-1] == pytest.approx(steps / lengths[:, None], abs=0.1)
    assert weighted[1:-1] == pytest.approx(lengths * pad.path(0)[1][1:-1], rel=0.1)
