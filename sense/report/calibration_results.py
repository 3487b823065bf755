"""All that a calibration leaves in a folder: the localizer, what health is told by, the document and its figures."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from padforge.design.common.files import atomic_files, check_replaceable, check_writable, write_json
from padforge.design.common.profiling import stage
from padforge.design.common.validation import InputError
from padforge.sense.health.learning import learn_health
from padforge.sense.health.model_folder import health_files
from padforge.sense.localizer.calibration.calibration import calibrate, left_out
from padforge.sense.recordings.recording import Recording
from padforge.sense.settings import LocalizerSettings

FILES = (
    *("localizer.json", "localizer.safetensors", "calibration.json", "error_map.png", "error_by_loss.png"),
    *sorted(health_files()),
)
"""Names of all that a calibration writes; of health, what can be learnt."""


def calibrate_into(
    recording: Recording,
    out: Path,
    options: LocalizerSettings,
    *,
    time_budget: float | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    warn: Callable[[str], None] = lambda line: None,
    force: bool = False,
) -> dict[str, Any]:
    """Calibrate, write all results to `out`, and return `calibration.json`.

    Nothing in `out` changes before the last result is there.

    Args:
        time_budget: seconds to train for, see `calibrate`.
        progress: called with (steps of training done, in all), and (0, 0) when the health of the fibres is learnt.
        warn: told in a line what is not learnt, of depth, force or health, as the recording does not suffice.
        force: whether a localizer is replaced that others in `out` were made from.

    Raises:
        InputError: as `calibrate`, `out` cannot be written, or others were made from the localizer in it.
    """
    check_writable(out)
    path, known = out / FILES[0], {"seed": options.seed, "inputs": {"recording": recording.digest}}
    check_replaceable(path, known, FILES, force)
    localizer, document = calibrate(recording, options, time_budget=time_budget, progress=progress)
    for line in left_out(recording, localizer):
        warn(line)
    progress(0, 0)
    with stage("health"):
        try:
            health = learn_health(recording, localizer.test, localizer.provenance)
        except InputError as error:
            health = {}
            warn(f"no watch is kept on the fibres' health: {error}")
    with atomic_files(
        out, without=health_files() - health_files(health)
    ) as folder:  # it must not speak for another model
        localizer.save(folder)
        check_replaceable(path, folder / path.name, FILES, force)  # other settings may be told by the result alone
        for name, model in health.items():
            model.save(folder, name)
        write_json(folder / "calibration.json", document)
        with stage("figures"):
            from padforge.sense.report.calibration_figures import draw_error_by_loss, draw_error_map

            draw_error_map(document, folder / "error_map.png")
            draw_error_by_loss(document, folder / "error_by_loss.png")
    return document


def calibration_lines(document: Mapping[str, Any]) -> list[str]:
    """The errors of a calibration document as tables for people: of places, and of depth and force if learnt."""
    names = ("mean_mm", "std_mm", "max_mm", "median_mm", "p95_mm")
    of = " of a simulated pad" if document["provenance"].get("recording_kind") == "simulated" else ""
    return [
        f"error in mm on {document['test_presses']} presses{of} (split: {document['split']})",
        "lost  sets   mean    std    max median    p95  in r50  in r90",
        *(
            f"{row['lost']:4d} {row['subsets']:5d} {' '.join(f'{row[name]:6.2f}' for name in names)} "
            f"{row['within_r50']:7.1%} {row['within_r90']:7.1%}"
            for row in document["errors"]
        ),
        *measure_lines(document["errors"]),
    ]


def measure_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Errors of depth and force as tables for people, by rows of "errors"; none where they were not learnt."""
    out = []
    for kind, unit in (("depth", "mm"), ("force", "N")):
        names = (f"{kind}_mean_{unit.lower()}", f"{kind}_p95_{unit.lower()}")
        if names[0] in rows[0]:
            out += [f"error of {kind} in {unit}", "lost  sets   mean    p95  in r90"]
            out += [
                f"{row['lost']:4d} {row['subsets']:5d} {' '.join(f'{row[name]:6.2f}' for name in names)} "
                f"{row[f'{kind}_within_r90']:7.1%}"
                for row in rows
            ]
    return out
