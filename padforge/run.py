"""Chain all stages of a pad, as `padforge run` does: design, mould, recording, contact comparison, calibration.

The mould, which no other stage needs, is built by a process in the background. A run may have a time budget. Every
stage is cached by the digest of its settings and inputs, so that an interrupted run can be resumed.
"""

import hashlib
import json
import logging
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial
from importlib import metadata
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, TypeVar

from padforge.common import profiling
from padforge.common.command_line import INTERRUPTED
from padforge.common.files import is_local, read_json, reraise_as_input_error, sha256, write_json
from padforge.common.validation import InputError

from .settings import SECTIONS, check_settings

if TYPE_CHECKING:
    from padforge.common.progress import OnProgress
    from padforge.common.settings import Settings, Spec
    from padforge.design.optimize.search import SearchResult
    from padforge.sense.settings import LocalizerSettings

_log = logging.getLogger(__name__)

_STAGE_SECTIONS = {
    "design": ("pad", "contact", "search", "rules"),
    "mould": ("pad", "rules", "mould", "printer", "silicone", "fibre", "dispenser"),
    "recording": ("pad", "contact", "rig"),
    "contacts": ("pad", "contact", "search"),
    "calibration": ("localizer",),
}
"""Sections that the result of each stage depends on."""

EPOCHS = 80
"""Passes of the training through the presses unless `[localizer]` states them: about half of the default of `padforge
sense calibrate`. That makes errors on a simulated pad larger by 1 to 3 %, and on a built one by 2 to 5 %."""
RESERVE_S = 30.0  # reserved after the training for calibration of radii, errors, fault detection, figures and report
FORMAT = "padforge-run/1"
NAME = "run.json"
PAD = "morphology.json"

Result = TypeVar("Result")


def _read_section(spec: "Spec", name: str) -> "Settings":
    """Read a section; the contact is completed with the lengths of the cast pad, the localizer with `EPOCHS`."""
    from padforge.design.settings import read_contact

    if name == "contact":
        return read_contact(spec)
    return _read_localizer(spec) if name == "localizer" else spec.section(resolve_name(SECTIONS[name]))


def _read_localizer(spec: "Spec", seed: int | None = None) -> "LocalizerSettings":
    from padforge.sense.settings import LocalizerSettings

    epochs = spec.stated(LocalizerSettings).get("epochs", EPOCHS)
    return spec.section(LocalizerSettings, epochs=epochs, seed=seed)


@dataclass(frozen=True)
class Run:
    """The request for a run."""

    spec: "Spec"  # settings of all stages
    out: Path  # folder of the pad
    seed: int | None = None  # of every random choice; None for the seeds of the sections
    formats: tuple[str, ...] = ("stl", "step", "svg", "png")  # files of the mould
    resume: bool = False  # whether to reuse the stages that an earlier run has finished
    time_budget: float | None = None  # seconds for all stages together; unlimited if None
    force: bool = False  # whether to replace even a pad in use, or a localizer not trained on simulated presses
    started_s: float = field(default_factory=time.monotonic)

    def remaining_s(self, share: float = 1.0, reserve_s: float = 0.0) -> float | None:
        """Return the seconds that remain of a share of the time budget, less a reserve; None without a budget."""
        if self.time_budget is None:
            return None
        return max(0.0, share * self.time_budget - (time.monotonic() - self.started_s) - reserve_s)


class _StageCache:
    """The finished stages of a run, recorded in `run.json`; `reused` lists those loaded from an earlier run."""

    def __init__(self, run: Run) -> None:
        """Read the record of an earlier run, or delete it if the run is not resumed."""
        self.reused: list[str] = []
        self._run, self._path = run, run.out / NAME
        self._stages: dict[str, dict[str, Any]] = {}
        if run.resume and self._path.exists():
            with reraise_as_input_error(self._path):
                for stage, entry in dict(read_json(self._path, FORMAT)["stages"]).items():
                    files = {str(name): digest for name, digest in dict(entry["files"]).items()}
                    self._stages[stage] = {"cache_key": entry["cache_key"], "files": files}
        if not self._stages:  # results of an earlier run will be replaced
            self._path.unlink(missing_ok=True)

    def get(
        self,
        stage: str,
        files: Callable[[Result], Iterable[str]],
        compute: Callable[[Callable[[Result], None]], Result],
        load: Callable[[], Result],
        **inputs: Any,
    ) -> Result:
        """Return the result of a stage, loaded if an earlier run had the same settings and inputs, otherwise computed.

        `files` returns the names of a result's files; results without files are not recorded. The argument of `compute`
        is a function that it may call to record the result as soon as its files are written. `inputs` are digests.
        """
        key = self._key(stage, inputs)
        if self.has(stage, **inputs):
            self.reused.append(stage)
            return load()

        def record(result: Result) -> None:
            if digests := self._digests(files(result)):
                self._stages[stage] = {"cache_key": key, "files": digests}
                write_json(self._path, {"format": FORMAT, "stages": self._stages})

        result = compute(record)
        record(result)
        return result

    def has(self, stage: str, **inputs: Any) -> bool:
        """Return whether an earlier run has the result of a stage, as `get` would find it."""
        entry = self._stages.get(stage)
        if entry is None or entry["cache_key"] != self._key(stage, inputs):
            return False
        return entry["files"] == self._digests(entry["files"])

    def _key(self, stage: str, inputs: Mapping[str, Any]) -> str:
        from padforge.design.settings import Contact

        run, names = self._run, _STAGE_SECTIONS[stage]
        content = {
            "settings": {name: _read_section(run.spec, name).model_dump(mode="json") for name in names},
            # A search uses a stated contact alone, even if it equals the default.
            "stated": {"contact": run.spec.stated(Contact)} if "contact" in names else {},
            "seed": run.seed,
            "inputs": inputs,
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def _digests(self, names: Iterable[str]) -> dict[str, str]:
        paths = {name: self._run.out / name for name in names if is_local(name)}
        return {name: sha256(path) for name, path in paths.items() if path.exists()}


def check_run(run: Run) -> None:
    """Check for errors that would occur only after minutes of work, and for data that a run must not replace.

    Raises:
        InputError: settings are invalid or inconsistent, or the folder has a measured recording, or a pad or localizer
            that is in use.
    """
    import numpy as np

    from padforge.design.contact import describe_large_strain
    from padforge.design.contact_comparison import design_contact
    from padforge.design.contact_set import judged_contacts
    from padforge.design.design_run import check_design
    from padforge.design.morphology import Morphology
    from padforge.design.settings import PadSettings, SearchSettings
    from padforge.fabricate import FabricationSettings
    from padforge.fabricate.export import require_formats
    from padforge.sense.localizer.calibration import split_presses
    from padforge.sense.localizer.model import FORMAT as LOCALIZER_FORMAT
    from padforge.sense.recording.press_plan import describe_other_depth
    from padforge.sense.recording.recording import check_replaceable
    from padforge.sense.settings import LocalizerSettings, read_rig
    from padforge.sense.simulation.simulated_recording import plan_simulation

    check_settings(run.spec)
    require_formats(run.formats)
    pad, rig = run.spec.section(PadSettings), read_rig(run.spec, seed=run.seed)
    FabricationSettings.from_spec(run.spec).require_consistent(pad.layout)
    rig.inputs(pad.layout.fibres)
    search = run.spec.section(SearchSettings)
    contact = design_contact(run.spec, search)
    judged_contacts(contact, search)
    plan = plan_simulation(Morphology.straight(pad.layout), rig, contact, pad)
    for notice in filter(None, (describe_other_depth(plan.depths_mm, contact), describe_large_strain(contact))):
        _log.warning(notice)
    if "step" in run.formats:
        metadata.version("build123d")  # if it is missing, this raises now and not after the search, as below
    localizer = run.spec.section(LocalizerSettings)
    if localizer.method == "published":
        metadata.version("torch")
    if run.time_budget is not None and localizer.method == "published":
        reason = "allowed is ensemble: the published training has no time limit"
        raise InputError(f"[localizer] method: got published with --time-budget, {reason}")
    if run.time_budget is not None and run.time_budget <= RESERVE_S:
        reason = f"more than {RESERVE_S:g}, which are reserved for what comes after the training"
        raise InputError(f"--time-budget: got {run.time_budget:g} s, expected {reason}")
    split_presses(np.arange(len(plan)), localizer.split, localizer.test_share, np.random.default_rng(0))
    check_replaceable(run.out / "recording")
    check_design(run.spec, run.out, {"seed": run.seed}, _regenerated_files(), run.force)
    path = run.out / "localizer.json"
    if path.exists() and not run.force:
        try:
            with reraise_as_input_error(path):
                kind = read_json(path, LOCALIZER_FORMAT)["provenance"].get("recording_kind")
            if kind != "simulated":
                raise InputError(f"{path}: trained on a recording of kind {kind!r}, not a simulated one")
        except InputError as error:
            raise InputError(f"{error}; choose another --out, or replace it with --force") from error


def _regenerated_files() -> set[str]:
    """Return the names of the files that a run writes together with the pad."""
    from padforge.sense.report.calibration import FILES

    return {"fabrication.json", "recording", "contacts.json", *FILES}


def run_stages(
    run: Run,
    on_line: Callable[[str], None],
    search_progress: "Callable[[], AbstractContextManager[OnProgress]]",
    training_progress: "Callable[[], AbstractContextManager[OnProgress]]",
) -> int:
    """Run all stages into `run.out`, and return the exit code: 1 if a rule or a check fails, 130 after an interrupt.

    `on_line` receives the lines that summarize every stage; the other two open displays of progress.
    """
    from padforge.common.background import BackgroundProcess
    from padforge.common.parallel import Checkpoints
    from padforge.design.contact_comparison import compare_contacts
    from padforge.design.design_run import load_result, run_design, summary_lines
    from padforge.design.optimize.search import SearchOptions
    from padforge.design.report import contact_lines
    from padforge.fabricate import FabricationSettings, build
    from padforge.fabricate.cli import mould_lines
    from padforge.sense.localizer.evaluation import calibration_lines
    from padforge.sense.recording.recording import Recording
    from padforge.sense.report.calibration import FILES, calibrate_into
    from padforge.sense.rig.operation import record_simulated
    from padforge.sense.settings import RigSettings

    spec, out, seed, cache = run.spec, run.out, {"seed": run.seed}, _StageCache(run)

    def search(record: "Callable[[SearchResult], None]") -> "SearchResult":
        with search_progress() as on_progress:
            options = SearchOptions(on_progress, resume=run.resume, time_budget=run.remaining_s(0.5))
            return run_design(spec, out, seed, None, options, None, record, _regenerated_files(), run.force)[1]

    def calibrate(_: object) -> dict[str, Any]:
        options, budget = _read_localizer(spec, run.seed), run.remaining_s(reserve_s=RESERVE_S)
        if budget == 0:
            reason = "nothing of it remains for the training; continue with --resume and more"
            raise InputError(f"--time-budget: got {run.time_budget:g} s, {reason}")
        with training_progress() as report:
            return calibrate_into(recording, out, options, time_budget=budget, on_progress=report, force=True)

    def read_document(name: str) -> dict[str, Any]:
        return json.loads((out / name).read_bytes())

    cad = ["padforge.fabricate.cad.model"] if "step" in run.formats else []
    with BackgroundProcess(cad) as worker:
        design = cache.get(
            "design",
            lambda result: [] if result.stopped == "interrupted" else ["design.json", PAD],
            search,
            lambda: load_result(out),
        )
        for line in summary_lines(design, out):
            on_line(line)
        if design.stopped == "interrupted":
            return INTERRUPTED
        if not design.stopped:
            Checkpoints(out / "search", {}).clear()  # left by a run that was killed just after it wrote its results
        pad, source, digest = design.morphology, [out / PAD], sha256(out / PAD)
        mould_inputs = {"pad": digest, "formats": sorted(run.formats)}
        if not cache.has("mould", **mould_inputs):
            worker.submit(build, pad, out, run.formats, FabricationSettings.from_spec(spec), source)
        plan = spec.section(RigSettings).plan_file
        recording = cache.get(
            "recording",
            lambda _: ["recording"],
            lambda _: record_simulated(spec, pad, out / "recording", seed, source, replacing=True),
            lambda: Recording.open(out / "recording"),
            pad=digest,
            plan=plan and sha256(plan),
        )
        on_line(f"sense: {len(recording.presses_mm)} presses on the simulated rig -> {out / 'recording'}")
        contacts = cache.get(
            "contacts",
            lambda _: ["contacts.json"],
            lambda _: compare_contacts(spec, pad, out, run.seed),
            partial(read_document, "contacts.json"),
            pad=digest,
        )
        calibration = cache.get(
            "calibration",
            lambda _: FILES,
            calibrate,
            partial(read_document, "calibration.json"),
            recording=recording.digest,
        )
        for line in calibration_lines(calibration):
            on_line(f"  {line}")
        for line in contact_lines(contacts):
            on_line(line)
        with profiling.stage("mould"):
            mould = cache.get(
                "mould",
                lambda document: ["fabrication.json", *document["sha256"]],
                lambda _: worker.result().to_dict(),
                partial(read_document, "fabrication.json"),
                **mould_inputs,
            )
    for line in mould_lines(mould, out):
        on_line(line)
    if cache.reused:
        reused = sorted(cache.reused, key=list(_STAGE_SECTIONS).index)
        _log.info("%s: reused from an earlier run: %s", out, ", ".join(reused))
    return int(bool(design.violations) or any(finding["status"] == "fail" for finding in mould["findings"]))
