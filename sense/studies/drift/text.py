"""What the study of drift shows, in sentences."""

from collections.abc import Mapping, Sequence
from typing import Any

from padforge.sense.localizer.evaluation import ACTIVE

Rows = Sequence[Mapping[str, Any]]

TABLE_III = (
    "Table III of the paper has 78 % (square) and 77 % (N = 5) in its experiment, by the rule of 2 %. Its published "
    "recording of the pad of N = 5 gives 16 to 18 % by that rule, whether readings are denoised or not: the table "
    "cannot be reproduced from the data."
)
"""Said with every study, for whoever compares."""


def told(settings: Mapping[str, Any], rows: Rows, idle: Rows) -> list[str]:
    """Paragraphs about the rows of the study and its idle shares ("label", "kind", "idle_percent")."""
    share = 100 * settings["test_share"]
    text = [
        f"Networks of {settings['hidden']} neurons find presses from readings denoised in {len(settings['denoise'])} "
        f"ways, whose drift is taken off in {len(settings['compensate'])}. Errors are means of {settings['members']} "
        f"networks, on presses never trained on: {share:g} % drawn at random, and the last {share:g} % of the "
        "recording, by which the drift has gone on."
    ]
    for label in dict.fromkeys(row["recording"] for row in rows):
        text.append(_of_recording([row for row in rows if row["recording"] == label]))
    model = [each for each in idle if each["kind"] == "contact model"]
    if model:
        shares = _listed([f"{each['idle_percent']:.1f} % ({each['label']})" for each in model])
        text.append(f"By the contact model a fibre is idle in {shares} of the presses of the published serpentine.")
    of_readings = [
        f"{each['idle_percent']:.1f} % ({each['label']}, {each['kind']})" for each in idle if each not in model
    ]
    text.append(
        f"By its readings, where a change of at most {100 * ACTIVE:g} % of its range over all presses counts as idle, "
        f"a fibre is idle in {_listed(of_readings)} of the presses: noise beyond that counts as an answer."
    )
    text.append(TABLE_III)
    return text


def _of_recording(rows: Rows) -> str:
    """What is best, and what compensation and denoising each bring to it."""
    best, at_end = (min(rows, key=lambda row: row[key]) for key in ("mean_mm", "mean_last_mm"))
    bare = next(row for row in rows if (row["denoise"], row["compensate"]) == (best["denoise"], "none"))
    alike = [row for row in rows if row["compensate"] == best["compensate"]]
    raw = next(row for row in alike if row["denoise"] == "none")
    filtered = min((row for row in alike if row is not raw), key=lambda row: row["mean_mm"])
    leasts = [
        min((row for row in rows if row["compensate"] == scheme), key=lambda row: row["mean_mm"])
        for scheme in dict.fromkeys(row["compensate"] for row in rows)
    ]
    by_scheme = _listed([f"{row['mean_mm']:.2f} mm ({_scheme(row)})" for row in leasts])
    return (
        f"{best['recording']}, {best['kind']}: presses drawn at random are found best by {_scheme(best)}, "
        f"{best['mean_mm']:.2f} mm off (standard deviation of the networks {best['std_mm']:.2f} mm), and the last ones "
        f"by {_scheme(at_end)}, {at_end['mean_last_mm']:.2f} mm off. Each compensation with the filter that suits it "
        f"best gives {by_scheme}. Denoised as for the best but without compensation, presses are "
        f"{bare['mean_mm']:.2f} mm off, the last ones {bare['mean_last_mm']:.2f} mm, which is "
        f"{bare['mean_mm'] - best['mean_mm']:.2f} mm and {bare['mean_last_mm'] - at_end['mean_last_mm']:.2f} mm more "
        f"than the best. With the best compensation, readings as they are give {raw['mean_mm']:.2f} mm, and the filter "
        f"that suits it best, {filtered['denoise']}, {filtered['mean_mm']:.2f} mm."
    )


def _scheme(row: Mapping[str, Any]) -> str:
    readings = "readings as they are" if row["denoise"] == "none" else f"readings after {row['denoise']}"
    return f"'{row['compensate']}' of {readings}"


def _listed(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
