"""`padforge run`: the stages of a pad one after another, within a time budget, resumed where a run ended."""

import hashlib
import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

import click

from padforge.design.common.command_line import INTERRUPTED
from padforge.design.common.files import read_json, reraise_as_input_error, sha256, write_json
from padforge.design.common.validation import InputError

if TYPE_CHECKING:
    from padforge.design.common.settings import Settings, Spec
    from padforge.design.morphology import Morphology
    from padforge.design.optimize.search import SearchResult
    from padforge.sense.recordings.recording import Recording

SECTIONS = {
    "pad": "padforge.design.settings:PadSettings",
    "contact": "padforge.design.settings:Contact",
    "search": "padforge.design.settings:SearchSettings",
    "rules": "padforge.design.settings:RulesSettings",
    "mould": "padforge.fabricate.settings:MouldSettings",
    "printer": "padforge.fabricate.settings:PrinterSettings",
    "silicone": "padforge.fabricate.materials:SiliconeSettings",
    "fibre": "padforge.fabricate.materials:FibreSettings",
    "dispenser": "padforge.fabricate.settings:DispenserSettings",
    "rig": "padforge.sense.settings:RigSettings",
    "localizer": "padforge.sense.settings:LocalizerSettings",
}
"""The sections of a `pad.toml`, and where the settings of each are."""

SEARCH_SHARE = 0.5
"""Of a time budget, what the search may take of it at most."""
FINISH_S = 12.0
"""What is left of it for health, figures and report, s."""
_SETTINGS = {
    "design": ("pad", "contact", "search", "rules"),
    "mould": ("pad", "rules", "mould", "printer", "silicone", "fibre", "dispenser"),
    "recording": ("pad", "contact", "rig"),
    "contacts": ("pad", "contact", "search"),
    "calibration": ("localizer",),
}
"""The sections that each stage depends on."""


def sections() -> "dict[str, type[Settings]]":
    """The models of all sections, by name."""
    return {name: resolve_name(where) for name, where in SECTIONS.items()}


FORMAT, NAME = "padforge-run/1", "run.json"


class RunProgress:
    """The stages that a run into a folder has finished.

    Args:
        out: the folder. resume: whether to go on from what an earlier run has noted; else that is forgotten.

    Raises:
        InputError: the note cannot be read, or is none of padforge.
    """

    def __init__(self, out: Path, resume: bool) -> None:
        self._out, self._note = out, out / NAME
        self._stages: dict[str, dict[str, Any]] = {}
        if resume and self._note.exists():
            with reraise_as_input_error(self._note):
                self._stages = dict(read_json(self._note, FORMAT)["stages"])

    def begin(self) -> None:
        """Forget what is not to be gone on from: from now on another run's results are replaced."""
        if not self._stages:
            self._note.unlink(missing_ok=True)

    def has(self, stage: str, made_of: Mapping[str, Any]) -> bool:
        """Whether a stage was made of the same, and its files are as it has left them.

        Args:
            made_of: settings and digests of inputs, as JSON has them.
        """
        with reraise_as_input_error(self._note):
            before = self._stages.get(stage, {})
            same = before.get("made_of") == _digest(made_of)
            return same and dict(before["files"]) == self._digests(before["files"])

    def note(self, stage: str, made_of: Mapping[str, Any], files: Iterable[str] = ()) -> None:
        """Keep that a stage is done, with the names of its files and folders."""
        self._stages[stage] = {"made_of": _digest(made_of), "files": self._digests(files)}
        write_json(self._note, {"format": FORMAT, "stages": self._stages})

    def _digests(self, names: Iterable[str]) -> dict[str, str]:
        paths = {name: self._out / Path(name).name for name in names}
        return {name: sha256(path) for name, path in paths.items() if path.exists()}


def _digest(made_of: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Run:
    """A run as it is asked for.

    Attributes:
        spec: its settings. out: the folder of the pad.
        seed: of every random choice; that of each section if None.
        formats: files of the mould, see `padforge.fabricate.export.FORMATS`.
        resume: whether to go on from what an earlier run has done.
        time_budget: seconds for all of it; None for no end.
        force: whether to replace what others in `out` were made from, and what no run has made.
        begin_s: when it began, on the clock of `time.monotonic`.
    """

    spec: "Spec"
    out: Path
    seed: int | None = None
    formats: tuple[str, ...] = ("stl", "step", "svg", "png")
    resume: bool = False
    time_budget: float | None = None
    force: bool = False
    begin_s: float = field(default_factory=time.monotonic)

    @property
    def seeds(self) -> dict[str, Any]:
        """Settings that override those of a section."""
        return {"seed": self.seed}

    def made_of(self, stage: str, inputs: Mapping[str, str] | None = None) -> dict[str, Any]:
        """What a stage depends on, as JSON has it: settings, seed, and the digests of its inputs."""
        from padforge.design.settings import Contact

        used = {name: self.spec.section(sections()[name]).model_dump(mode="json") for name in _SETTINGS[stage]}
        stated = {"contact": self.spec.stated(Contact)} if "contact" in used else {}
        return {"settings": used, "stated": stated, "seed": self.seed, "inputs": dict(inputs or {})}

    def left_s(self, share: float = 1.0, keep_s: float = 0.0) -> float | None:
        """Seconds that are left of a share of the time budget, less what is kept for later; None without one."""
        if self.time_budget is None:
            return None
        return max(0.0, share * self.time_budget - (time.monotonic() - self.begin_s) - keep_s)


def check_ahead(run: Run) -> None:
    """Refuse what would fail only after minutes of work, or take away what no run makes again.

    Raises:
        InputError: any section, sections that do not fit, a real recording, or a pad or calibration to be kept.
    """
    import numpy as np

    from padforge.design.run import check_search
    from padforge.design.settings import PadSettings
    from padforge.fabricate import FabricationSettings
    from padforge.fabricate.export import require_formats
    from padforge.sense.localizer.calibration.calibration import split_presses
    from padforge.sense.recordings.recording import refuse_replacing
    from padforge.sense.settings import LocalizerSettings, RigSettings

    for model in sections().values():
        run.spec.section(model)
    require_formats(run.formats)
    FabricationSettings.from_spec(run.spec).require_consistent(run.spec.section(PadSettings).layout)
    learning = run.spec.section(LocalizerSettings)
    if run.time_budget is not None and learning.method == "published":
        raise InputError(
            "[localizer] method: got published with --time-budget, allowed is masked: the published training ends "
            "where it gains no more"
        )
    presses = run.spec.section(RigSettings).presses
    split_presses(presses, learning.split, learning.test_share, np.random.default_rng(0))
    refuse_replacing(run.out / "recording")
    check_search(run.spec, run.out, run.seeds, _remade(), run.force)
    _check_calibration(run)


def _remade() -> set[str]:
    """Names of what a run makes of a pad, beside its files of other kinds."""
    from padforge.design.contact_comparison import NAME
    from padforge.sense.report.calibration_results import FILES

    return {"fabrication.json", "recording", NAME, *FILES}


def _check_calibration(run: Run) -> None:
    """Refuse to replace a localizer that has learnt from other presses than simulated ones: no run makes it again."""
    from padforge.design.common.files import read_json, reraise_as_input_error
    from padforge.sense.localizer.localizer import FORMAT

    path = run.out / "localizer.json"
    if run.force or not path.exists():
        return
    with reraise_as_input_error(path):
        kind = read_json(path, FORMAT)["provenance"].get("recording_kind")
    if kind != "simulated":
        raise InputError(
            f"{path}: learnt from a recording of kind {kind!r}, not a simulated one; "
            "choose another --out, or replace it with --force"
        )


def run_stages(run: Run) -> int:
    """All stages into `run.out`, each with its summary on stdout; the exit code: 0, 1 if a rule or check fails, or 130.

    What an earlier run has finished of the same is kept if `run.resume`.
    """
    from padforge.design.common.files import sha256
    from padforge.design.report import contact_line
    from padforge.design.run import search_lines
    from padforge.fabricate.cli import mould_lines
    from padforge.sense.report.calibration_results import calibration_lines

    progress = RunProgress(run.out, run.resume)
    progress.begin()
    kept: list[str] = []
    found = _designed(run, progress, kept)
    click.echo("\n".join(search_lines(found, run.out)))
    if found.stopped == "interrupted":
        return INTERRUPTED
    pad = {"morphology.json": sha256(run.out / "morphology.json")}
    mould = _moulded(run, progress, kept, found.morphology, pad)
    click.echo("\n".join(mould_lines(mould, run.out)))
    recording = _recorded(run, progress, kept, found.morphology, pad)
    click.echo(f"sense: {len(recording.presses_mm)} presses on the simulated rig -> {run.out / 'recording'}")
    contacts = _compared(run, progress, kept, found.morphology, pad)
    calibration = _calibrated(run, progress, kept, recording)
    click.echo("\n".join(f"  {line}" for line in calibration_lines(calibration)))
    click.echo(contact_line(contacts))
    if kept:
        click.echo(f"{run.out}: kept as an earlier run has made it: {', '.join(kept)}", err=True)
    return int(bool(found.violations) or any(finding["status"] == "fail" for finding in mould["findings"]))


def _designed(run: Run, progress: RunProgress, kept: list[str]) -> "SearchResult":
    from padforge.design.common.checkpoints import Checkpoints
    from padforge.design.optimize.search import SearchOptions
    from padforge.design.run import load_result, run_search

    made_of = run.made_of("design")
    if progress.has("design", made_of) and (found := load_result(run.out)):
        kept.append("fibres")
        if not found.stopped:
            Checkpoints(run.out / "search", {}).clear()  # a kill came just before
        return found
    how = SearchOptions(resume=run.resume, time_budget=run.left_s(SEARCH_SHARE))

    def written(found: "SearchResult") -> None:
        if found.stopped != "interrupted":
            progress.note("design", made_of, ["design.json", "morphology.json"])

    return run_search(run.spec, run.out, run.seeds, run=how, written=written, remade=_remade(), force=run.force)[1]


def _moulded(
    run: Run, progress: RunProgress, kept: list[str], pad: "Morphology", inputs: Mapping[str, str]
) -> dict[str, Any]:
    from padforge.fabricate import FabricationSettings, build

    made_of = run.made_of("mould", inputs) | {"formats": sorted(run.formats)}
    if progress.has("mould", made_of):
        kept.append("mould")
        return _document(run.out / "fabrication.json")
    settings, warn = FabricationSettings.from_spec(run.spec), partial(click.echo, err=True)
    mould = build(pad, run.out, run.formats, settings, [run.out / name for name in inputs], warn=warn)
    progress.note("mould", made_of, ["fabrication.json", *mould["sha256"]])
    return mould


def _recorded(
    run: Run, progress: RunProgress, kept: list[str], pad: "Morphology", inputs: Mapping[str, str]
) -> "Recording":
    from padforge.design.common.files import sha256
    from padforge.sense.recordings.recording import Recording
    from padforge.sense.rig.operation import record_simulated
    from padforge.sense.settings import RigSettings

    plan = run.spec.section(RigSettings).plan_file
    made_of = run.made_of("recording", {**inputs, **({plan.name: sha256(plan)} if plan else {})})
    if progress.has("recording", made_of):
        kept.append("recording")
        return Recording.open(run.out / "recording")
    paths = [run.out / name for name in inputs]
    recording = record_simulated(run.spec, pad, run.out / "recording", run.seeds, paths, replacing=True)
    progress.note("recording", made_of, ["recording"])
    return recording


def _compared(
    run: Run, progress: RunProgress, kept: list[str], pad: "Morphology", inputs: Mapping[str, str]
) -> dict[str, Any]:
    from padforge.design.contact_comparison import NAME, compare_contacts

    made_of = run.made_of("contacts", inputs)
    if progress.has("contacts", made_of):
        kept.append("contacts")
        return _document(run.out / NAME)
    document = compare_contacts(run.spec, pad, run.out, run.seed)
    progress.note("contacts", made_of, [NAME])
    return document


def _calibrated(run: Run, progress: RunProgress, kept: list[str], recording: "Recording") -> dict[str, Any]:
    from padforge.sense.cli.calibration import run_calibration
    from padforge.sense.report.calibration_results import FILES

    made_of = run.made_of("calibration", {"recording": recording.digest})
    if progress.has("calibration", made_of):
        kept.append("calibration")
        return _document(run.out / "calibration.json")
    document = run_calibration(run.spec, recording, run.out, run.seeds, run.left_s(keep_s=FINISH_S), force=True)
    progress.note("calibration", made_of, FILES)
    return document


def _document(path: Path) -> dict[str, Any]:
    """A document whose digest is the one that was noted as it was written."""
    return json.loads(path.read_text(encoding="utf-8"))
