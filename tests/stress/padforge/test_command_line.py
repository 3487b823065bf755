"""Thousands of hostile command lines: each ends in time, with one line and nothing changed, or with results."""

import json
from itertools import chain

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.effort import few
from tests.stress.door import HOSTILE, PATHS, Workshop

MORPHOLOGY, MESH = ("pad/morphology.json",), ("pad/mould.stl", "pad/mould.3mf")
RECORDING = ("pad/recording", "presses.csv")
MODEL, SPEC, FOLDER = ("pad",), ("pad.toml", "other.toml"), ("new", "pad", "new/deep", "empty")
SEED = ("0", "4294967295")

COMMANDS: dict[tuple[str, ...], tuple[list[tuple[str, ...]], dict[str, tuple[str, ...] | None]]] = {
    (): ([], {"--version": None, "--help": None, "-h": None}),
    ("init",): ([("new.toml",)], {}),
    ("report",): ([("pad",)], {}),
    ("bench", "no-such-bench"): ([], {"--out": FOLDER, "--json": None}),
    ("run", "--spec", "bad.toml"): ([], {"--seed": SEED, "--out": ("file",)}),
    ("design",): (
        [],
        {
            "--spec": SPEC,
            "--method": ("descent", "genetic"),
            "--knots": ("1", "2"),
            "--starts": ("1",),
            "--from": ("random", "straight", "pad/morphology.json"),
            "--device": ("cpu",),
            "--time-budget": ("0", "1e-3", "5"),
            "--resume": None,
            "--seed": SEED,
            "--out": FOLDER,
            "--json": None,
        },
    ),
    ("design", "show"): ([MORPHOLOGY], {"--spec": SPEC, "--out": ("new.svg", "new.png")}),
    ("design", "check"): ([MORPHOLOGY], {"--spec": SPEC, "--json": None}),
    ("design", "score"): ([MORPHOLOGY], {"--spec": SPEC}),
    ("design", "import"): (
        [("plan.svg", "plan.dxf")],
        {"--spec": SPEC, "--tolerance-mm": ("0.05", "1e-3", "10"), "--out": FOLDER, "--json": None},
    ),
    ("fabricate",): (
        [MORPHOLOGY],
        {"--formats": ("stl", "3mf,svg", "", "dxf,png"), "--spec": SPEC, "--out": FOLDER, "--json": None},
    ),
    ("fabricate", "check"): ([(*MORPHOLOGY, *MESH)], {"--spec": SPEC, "--picture": ("new.png",), "--json": None}),
    ("sense", "import"): ([("presses.csv", "presses.h5")], {"--out": ("new",)}),
    ("sense", "export"): ([RECORDING, ("new.csv", "new.h5")], {}),
    ("sense", "record"): (
        [],
        {
            "--rig": ("simulated",),
            "--morphology": MORPHOLOGY,
            "--presses": ("4", "5"),
            "--plan": ("presses.csv", "grid", "adaptive"),
            "--model": MODEL,
            "--dry-run": None,
            "--resume": None,
            "--seed": SEED,
            "--spec": SPEC,
            "--out": ("new", "new/deep", "empty"),
        },
    ),
    ("sense", "doctor", "--rig", "ur5"): ([], {"--spec": SPEC, "--json": None}),
    ("sense", "calibrate"): (
        [RECORDING],
        {
            "--method": ("masked", "published"),
            "--features": ("full", "causal", "early", "published"),
            "--test-split": ("random", "chronological"),
            "--seed": SEED,
            "--spec": SPEC,
            "--out": FOLDER,
            "--json": None,
        },
    ),
    ("sense", "evaluate"): ([RECORDING], {"--model": MODEL, "--lost": ("0", "1", "3"), "--json": None}),
    ("sense", "locate"): ([RECORDING], {"--model": MODEL, "--mask": ("1", "1,2,3"), "--out": ("new.csv",)}),
    ("sense", "health"): ([RECORDING], {"--model": MODEL, "--json": None}),
    ("sense", "recalibrate"): ([RECORDING], {"--model": ("empty",), "--seed": SEED, "--out": FOLDER, "--json": None}),
    ("sense", "fibre-loss"): (
        [RECORDING],
        {
            **{"--model": MODEL, "--lost": ("0", "1"), "--failed": ("1", "1,2"), "--seed": SEED},
            **{"--spec": SPEC, "--out": FOLDER, "--json": None},
        },
    ),
    ("sense", "learning-curve"): ([RECORDING], {"--seed": SEED, "--spec": SPEC, "--out": FOLDER, "--json": None}),
    ("sense", "live", "--replay", "pad/recording"): (
        [],
        {"--model": MODEL, "--speed": ("1e6", "1e300"), "--port": ("0",), "--spec": SPEC, "--json": None},
    ),
    **{
        ("study", name, "no-such-pad"): (
            [("no-such-pad", "square@999", "random-100")],
            {"--seed": SEED, "--jobs": ("1",), "--out": FOLDER},
        )
        for name in ("robustness", "sensitivity", "scaling", "force", "shape", "drift", "multicontact")
    },
}
"""Every command, with values that suit its arguments in order and its options; None for a flag.

Studies and benches take minutes, so they are given a name that they refuse.
"""

ALWAYS = {"--speed": "1e6", "--port": "0", "--formats": "stl"}
"""Without these `live` lasts as long as the recording, and takes a port that others may have; CAD takes long."""


@pytest.fixture(scope="module")
def workshop(tmp_path_factory) -> Workshop:
    return Workshop(tmp_path_factory.mktemp("workshop"))


@st.composite
def command_lines(draw: st.DrawFn) -> list[str]:
    """A command with about one thing wrong, or several, or none; rarely, words in any order."""
    command = draw(st.sampled_from(sorted(COMMANDS)))
    arguments, options = COMMANDS[command]
    wrong = st.one_of(
        st.sampled_from(PATHS), st.sampled_from(HOSTILE), st.text(st.characters(exclude_characters="\0/"), max_size=20)
    )
    one_in = draw(st.sampled_from((1, 3, 6)))

    def value(right: tuple[str, ...]) -> str:
        return draw(wrong) if draw(st.integers(1, one_in)) == 1 else draw(st.sampled_from(right))

    words = [[value(right)] for right in arguments]
    needed = [name for name in ("--model", "--out", *ALWAYS) if name in options]
    names = draw(st.lists(st.sampled_from(sorted(options)), max_size=3)) if options else []
    for name in chain(names, (name for name in needed if draw(st.integers(0, 9)) and name not in names)):
        right = options[name]
        given_value = ALWAYS[name] if name in ALWAYS and name not in names else None
        words.append([name] if right is None else [name, given_value or value(right)])
    match draw(st.integers(0, 19)):
        case 0:
            words.append([draw(wrong)])
        case 1 if words:
            words.pop(draw(st.integers(0, len(words) - 1)))
        case 2 if words:
            words[-1].pop()
        case 3 if words:
            words.append(words[0])
        case 4:
            words.append(
                [draw(st.sampled_from(["--no-such-option", "-x", "--out", "--seed=", "--spec=", "--json=1", "--"]))]
            )
    return [*command, *chain.from_iterable(draw(st.permutations(words)))]


@few(60)
@given(words=command_lines())
def test_any_command_line_ends_as_it_may(workshop: Workshop, words: list[str]):
    for command, names in (("live", ("--speed", "--port")), ("fabricate", ("--formats",))):
        if command in words[:2] and "check" not in words:
            words += chain.from_iterable((name, ALWAYS[name]) for name in names if name not in words)
    ended = workshop.run(*words)
    if ended.code in (0, 1) and "--json" in words and not {"-h", "--help", "--version"} & set(words) and ended.out:
        documents = ended.out.splitlines() if "live" in words else [ended.out]
        assert all(map(json.loads, documents))
