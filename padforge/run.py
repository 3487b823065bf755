"""Chain all stages of a pad, as `padforge run` does: design, mould, recording, contact comparison, calibration.

A run may have a time budget. Every stage is cached by the digest of its settings and inputs, so that an interrupted run
is resumed where it ended.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, TypeVar

from padforge.design.common.command_line import INTERRUPTED
from padforge.design.common.files import read_json, reraise_as_input_error, sha256, write_json
from padforge.design.common.validation import InputError

if TYPE_CHECKING:
    from padforge.design.common.settings import Settings, Spec
    from padforge.design.optimize.search import OnProgress, SearchResult
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
"""Sections of a `pad.toml`, and the model of each."""

_STAGE_SECTIONS = {
    "design": ("pad", "contact", "search", "rules"),
    "mould": ("pad", "rules", "mould", "printer", "silicone", "fibre", "dispenser"),
    "recording": ("pad", "contact", "rig"),
    "contacts": ("pad", "contact", "search"),
    "calibration": ("localizer",),
}
"""Sections that the result of each stage depends on."""

SEARCH_SHARE = 0.5
"""Largest share of the time budget that the search may use."""
RESERVE_S = 12.0
"""Part of the time budget reserved for fault detection, figures and report after the training, s."""
FORMAT, NAME = "padforge-run/2", "run.json"
PAD = "morphology.json"

Result = TypeVar("Result")


def section_models() -> "dict[str, type[Settings]]":
    """Import the models of all sections, by name."""
    return {name: resolve_name(path) for name, path in SECTIONS.items()}


@dataclass(frozen=True)
class Run:
    """The request for a run.

    Attributes:
        spec: settings of all stages.
        out: folder of the pad.
        seed: seed of every random choice; that of each section if None.
        formats: file formats of the mould, see `padforge.fabricate.export.FORMATS`.
        resume: whether to reuse the stages that an earlier run has finished.
        time_budget: seconds for all stages together; unlimited if None.
        force: whether to replace a pad from which other files in `out` were made, and a localizer that was not trained
            on simulated presses.
        started_s: start on the clock of `time.monotonic`.
    """

    spec: "Spec"
    out: Path
    seed: int | None = None
    formats: tuple[str, ...] = ("stl", "step", "svg", "png")
    resume: bool = False
    time_budget: float | None = None
    force: bool = False
    started_s: float = field(default_factory=time.monotonic)

    @property
    def overrides(self) -> dict[str, Any]:
        """Settings that override those of each section."""
        return {"seed": self.seed}

    def cache_key(self, stage: str, inputs: Mapping[str, str], **options: Any) -> str:
        """Return the digest of everything that the result of a stage depends on.

        Args:
            stage: name of the stage.
            inputs: digests of its input files by name.
            **options: further options, as JSON.
        """
        from padforge.design.settings import Contact

        models, names = section_models(), _STAGE_SECTIONS[stage]
        content = {
            "settings": {name: self.spec.section(models[name]).model_dump(mode="json") for name in names},
            # a contact that is stated is designed for, even if it is the default one
            "stated": {"contact": self.spec.stated(Contact)} if "contact" in names else {},
            "seed": self.seed,
            "inputs": dict(inputs),
            "options": options,
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def remaining_s(self, share: float = 1.0, reserve_s: float = 0.0) -> float | None:
        """Return the seconds that remain of a share of the time budget, less a reserve; None without a budget."""
        if self.time_budget is None:
            return None
        return max(0.0, share * self.time_budget - (time.monotonic() - self.started_s) - reserve_s)


class StageCache:
    """Stages that a run into a folder has finished, noted in `run.json`.

    Attributes:
        reused: stages whose results of an earlier run were reused.
    """

    def __init__(self, out: Path, resume: bool) -> None:
        """Read the note of an earlier run, or delete it if it is not to be resumed.

        Args:
            out: folder of the pad.
            resume: whether to reuse finished stages.

        Raises:
            InputError: the note is damaged.
        """
        self.reused: list[str] = []
        self._out, self._note = out, out / NAME
        self._stages: dict[str, dict[str, Any]] = {}
        if resume and self._note.exists():
            with reraise_as_input_error(self._note):
                self._stages = dict(read_json(self._note, FORMAT)["stages"])
        if not self._stages:  # from now on the results of another run are replaced
            self._note.unlink(missing_ok=True)

    def has(self, stage: str, key: str) -> bool:
        """Whether a stage was finished with the same cache key and its files are unchanged."""
        with reraise_as_input_error(self._note):
            entry = self._stages.get(stage, {})
            return entry.get("cache_key") == key and dict(entry["files"]) == self._digests(entry["files"])

    def add(self, stage: str, key: str, files: Iterable[str]) -> None:
        """Note that a stage is finished.

        Args:
            stage: name of the stage.
            key: its cache key.
            files: names of its files and folders.
        """
        self._stages[stage] = {"cache_key": key, "files": self._digests(files)}
        write_json(self._note, {"format": FORMAT, "stages": self._stages})

    def get(
        self,
        stage: str,
        key: str,
        load: Callable[[], Result],
        compute: Callable[[], Result],
        files: Callable[[Result], Iterable[str]],
    ) -> Result:
        """Return the result of a stage: loaded if it is cached, else computed and noted.

        Args:
            stage: name of the stage.
            key: its cache key.
            load: reads the result of an earlier run.
            compute: computes the result and writes its files.
            files: names the files of a result.
        """
        if self.has(stage, key):
            self.reused.append(stage)
            return load()
        result = compute()
        self.add(stage, key, files(result))
        return result

    def _digests(self, names: Iterable[str]) -> dict[str, str]:
        paths = {name: self._out / Path(name).name for name in names}
        return {name: sha256(path) for name, path in paths.items() if path.exists()}


def check_run(run: Run) -> None:
    """Raise now what would fail only after minutes of work, or replace data that no run makes again.

    Raises:
        InputError: invalid or inconsistent settings, a measured recording, or a pad or localizer that is in use.
    """
    import numpy as np

    from padforge.design.design_run import check_design
    from padforge.design.settings import PadSettings
    from padforge.fabricate import FabricationSettings
    from padforge.fabricate.export import require_formats
    from padforge.sense.localizer.calibration.calibration import split_presses
    from padforge.sense.localizer.localizer import FORMAT as LOCALIZER_FORMAT
    from padforge.sense.recordings.recording import refuse_replacing
    from padforge.sense.settings import LocalizerSettings, RigSettings

    for model in section_models().values():
        run.spec.section(model)
    require_formats(run.formats)
    FabricationSettings.from_spec(run.spec).require_consistent(run.spec.section(PadSettings).layout)
    localizer = run.spec.section(LocalizerSettings)
    if run.time_budget is not None and localizer.method == "published":
        raise InputError(
            "[localizer] method: got published with --time-budget, allowed is masked: the published training has no "
            "time limit"
        )
    presses = run.spec.section(RigSettings).presses
    split_presses(presses, localizer.split, localizer.test_share, np.random.default_rng(0))
    refuse_replacing(run.out / "recording")
    check_design(run.spec, run.out, run.overrides, _regenerated_files(), run.force)
    path = run.out / "localizer.json"
    if path.exists() and not run.force:
        with reraise_as_input_error(path):
            kind = read_json(path, LOCALIZER_FORMAT)["provenance"].get("recording_kind")
        if kind != "simulated":
            raise InputError(
                f"{path}: trained on a recording of kind {kind!r}, not a simulated one; "
                "choose another --out, or replace it with --force"
            )


def _regenerated_files() -> set[str]:
    """Return the names of the files that a run makes anew with the pad."""
    from padforge.design.contact_comparison import NAME as CONTACTS
    from padforge.sense.report.calibration_results import FILES

    return {"fabrication.json", "recording", CONTACTS, *FILES}


def run_stages(
    run: Run,
    on_result: Callable[[str], None],
    on_message: Callable[[str], None],
    search_progress: "Callable[[], AbstractContextManager[OnProgress]]",
) -> int:
    """Run all stages into `run.out`.

    Args:
        run: the request.
        on_result: receives the summary of every stage.
        on_message: receives warnings and notes.
        search_progress: opens a display that receives the progress of the search.

    Returns:
        The exit code: 0, 1 if a rule or a check of the mould fails, or 130 if the search was interrupted.
    """
    from padforge.design.contact_comparison import NAME as CONTACTS
    from padforge.design.contact_comparison import compare_contacts
    from padforge.design.design_run import summary_lines
    from padforge.design.report import contact_line
    from padforge.fabricate import FabricationSettings, build
    from padforge.fabricate.cli import mould_lines
    from padforge.sense.cli.calibration import run_calibration
    from padforge.sense.report.calibration_results import FILES, calibration_lines

    cache = StageCache(run.out, run.resume)
    design = _design(run, cache, search_progress)
    on_result("\n".join(summary_lines(design, run.out)))
    if design.stopped == "interrupted":
        return INTERRUPTED
    pad, pad_digest = design.morphology, {PAD: sha256(run.out / PAD)}

    mould = cache.get(
        "mould",
        run.cache_key("mould", pad_digest, formats=sorted(run.formats)),
        lambda: _load(run.out / "fabrication.json"),
        lambda: build(
            pad, run.out, run.formats, FabricationSettings.from_spec(run.spec), [run.out / PAD], warn=on_message
        ),
        lambda document: ["fabrication.json", *document["sha256"]],
    )
    on_result("\n".join(mould_lines(mould, run.out)))

    recording = _record(run, cache, design, pad_digest)
    on_result(f"sense: {len(recording.presses_mm)} presses on the simulated rig -> {run.out / 'recording'}")

    contacts = cache.get(
        "contacts",
        run.cache_key("contacts", pad_digest),
        lambda: _load(run.out / CONTACTS),
        lambda: compare_contacts(run.spec, pad, run.out, run.seed),
        lambda document: [CONTACTS],
    )
    calibration = cache.get(
        "calibration",
        run.cache_key("calibration", {"recording": recording.digest}),
        lambda: _load(run.out / "calibration.json"),
        lambda: run_calibration(
            run.spec, recording, run.out, run.overrides, run.remaining_s(reserve_s=RESERVE_S), force=True
        ),
        lambda document: FILES,
    )
    on_result("\n".join(f"  {line}" for line in calibration_lines(calibration)))
    on_result(contact_line(contacts))
    if cache.reused:
        on_message(f"{run.out}: reused from an earlier run: {', '.join(cache.reused)}")
    return int(bool(design.violations) or any(finding["status"] == "fail" for finding in mould["findings"]))


def _design(
    run: Run, cache: StageCache, search_progress: "Callable[[], AbstractContextManager[OnProgress]]"
) -> "SearchResult":
    """Optimise the fibres, or load them; a search that is interrupted is not cached."""
    from padforge.design.common.parallel import Checkpoints
    from padforge.design.design_run import load_result, run_design
    from padforge.design.optimize.search import SearchOptions

    key = run.cache_key("design", {})
    if cache.has("design", key) and (result := load_result(run.out)):
        cache.reused.append("design")
        if not result.stopped:
            Checkpoints(run.out / "search", {}).clear()  # a kill left them just after the results were written
        return result

    def add_to_cache(result: "SearchResult") -> None:
        if result.stopped != "interrupted":
            cache.add("design", key, ["design.json", PAD])

    with search_progress() as on_progress:
        return run_design(
            run.spec,
            run.out,
            run.overrides,
            options=SearchOptions(on_progress, resume=run.resume, time_budget=run.remaining_s(SEARCH_SHARE)),
            on_written=add_to_cache,
            regenerated=_regenerated_files(),
            force=run.force,
        )[1]


def _record(run: Run, cache: StageCache, design: "SearchResult", pad_digest: Mapping[str, str]) -> "Recording":
    """Record presses on the simulated rig, or open the recording."""
    from padforge.sense.recordings.recording import Recording
    from padforge.sense.rig.operation import record_simulated
    from padforge.sense.settings import RigSettings

    folder, plan = run.out / "recording", run.spec.section(RigSettings).plan_file
    return cache.get(
        "recording",
        run.cache_key("recording", {**pad_digest, **({plan.name: sha256(plan)} if plan else {})}),
        lambda: Recording.open(folder),
        lambda: record_simulated(run.spec, design.morphology, folder, run.overrides, [run.out / PAD], replacing=True),
        lambda recording: ["recording"],
    )


def _load(path: Path) -> dict[str, Any]:
    """Read a document whose digest was just compared with the noted one."""
    return json.loads(path.read_text(encoding="utf-8"))
