"""The plan of a cohort: its pairs as jobs, and the pairs that cannot run."""

import json
import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torchdeform import __version__
from torchdeform.cohort.learn2reg import submission_names
from torchdeform.cohort.names import PairSpec, select
from torchdeform.cohort.pairs import pair_specs
from torchdeform.cohort.schema import TISSUE, Cohort
from torchdeform.errors import InputError, nearest_name
from torchdeform.io import read_displacement, read_image
from torchdeform.io.files import atomic_file, atomic_folder
from torchdeform.io.gate import read_text, require_file, require_name
from torchdeform.io.transforms import write_voxel_displacement
from torchdeform.pipeline.register import Outcome, PairFiles, register_files
from torchdeform.pipeline.tissue import contradiction as unexplained_tissue
from torchdeform.registration.annotations import PAIRED
from torchdeform.registration.channels import contradiction
from torchdeform.registration.result import Callback
from torchdeform.registration.settings import RegistrationSettings


@dataclass(frozen=True, kw_only=True)
class Job:
    """A pair to register.

    Args:
        name: of the pair, unique in its cohort, of letters, digits, ``.``, ``_`` and ``-`` only.
        files: all paths absolute; ``files.out`` is the pair's own folder inside the cohort's.
        settings: of the pair, complete.
        device: ``auto``, ``cpu`` or ``cuda``.
        memory: limit in bytes, None for all that is free.
        report: ``none``, ``light`` or ``full``, see `register_files`.
        submission: file for the displacement as the Learn2Reg challenge reads it, None for none.
        also: further names of that file, which other versions of the challenge's evaluation look for.
        voxels: whether landmarks are rows of voxel indices without titles, as in Learn2Reg.
    """

    name: str
    files: PairFiles
    settings: RegistrationSettings
    device: str = "auto"
    memory: int | None = None
    report: str = "light"
    submission: Path | None = None
    also: tuple[Path, ...] = ()
    voxels: bool = False


SUBMISSION, DESCRIPTION = "submission", "dataset_description.json"

# Other names in a cohort's folder, which no pair may have.
_RESERVED = (
    "logs",
    SUBMISSION,
    "journal.jsonl",
    "summary.csv",
    "failures.csv",
    "index.html",
    "events.jsonl",
    DESCRIPTION,
)

_POINTS = ("fixed_points", "moving_points")
_WHAT = {"mask": "mask", "labels": "label image", "points": "file of landmarks", TISSUE: "label image"}


@dataclass(frozen=True)
class Failure:
    """A pair that failed or cannot run: its name, a sentence that says why, and its log, None if it never ran."""

    name: str
    sentence: str
    log: Path | None = None


@dataclass(frozen=True)
class Plan:
    """The pairs of a cohort.

    Attributes:
        out: folder of the cohort's results.
        jobs: pairs that can run, in the order of the cohort.
        problems: pairs that cannot run.
    """

    out: Path
    jobs: tuple[Job, ...]
    problems: tuple[Failure, ...] = ()

    def only(self, names: Iterable[str]) -> "Plan":
        """Return the plan of the pairs with these names, starts of names (``sub-01``) or patterns (``sub-0*``).

        Raises:
            InputError: a name that no pair has.
        """
        known = [one.name for one in (*self.jobs, *self.problems)]
        kept: set[str] = set()
        for name in names:
            found = select(known, name)
            if not found:
                raise InputError(f"--only: no pair is called {name!r}{nearest_name(name, known)}; see --dry-run")
            kept.update(found)
        jobs, problems = ([one for one in some if one.name in kept] for some in (self.jobs, self.problems))
        return replace(self, jobs=tuple(jobs), problems=tuple(problems))


def plan(cohort: Cohort) -> Plan:
    """Return the jobs of a cohort, and the pairs that cannot run.

    Raises:
        InputError: no pair at all, two pairs with the same folder, a name that the folder needs for something else, or
            wrong settings.

    Notes:
        Files are not read; only their existence is checked.
    """
    found = pair_specs(cohort)
    _require_apart(found, lambda pair: f"{pair.subject}/{pair.name}", "be called", "name")
    if cohort.layout == "learn2reg":
        whole = [pair for pair in found if not pair.problem]
        _require_apart(whole, lambda pair: _submissions(pair)[0], "be submitted as", "moving image")
    resolve = _resolver(cohort)
    jobs: list[Job] = []
    problems: list[Failure] = []
    for pair in found:
        settings = resolve(pair)
        sentence = pair.problem or _missing(pair) or _leading_out(pair, cohort.out) or _contradiction(pair, settings)
        if sentence:
            problems.append(Failure(pair.name, sentence))
        else:
            jobs.append(_job(pair, cohort, settings))
    return Plan(cohort.out, tuple(jobs), tuple(problems))


def description() -> dict[str, Any]:
    """Return the description of a cohort's folder, as BIDS asks for derived data."""
    return {
        "Name": "Registrations by torchdeform",
        "BIDSVersion": "1.10.0",
        "DatasetType": "derivative",
        "GeneratedBy": [{"Name": "torchdeform", "Version": __version__}],
    }


def _require_apart(found: Sequence[PairSpec], place: Callable[[PairSpec], str], verb: str, remedy: str) -> None:
    """Raise `InputError` if two pairs would write the same place. Case is ignored, as some file systems do."""
    seen: dict[str, PairSpec] = {}
    for pair in found:
        key = place(pair)
        first = seen.setdefault(key.casefold(), pair)
        if first is not pair:
            both = f"{_between(first)} ({first.where}) and {_between(pair)} ({pair.where})"
            raise InputError(f"{both} would both {verb} {key.strip('/')}; give each its own {remedy}")
        if pair.name.casefold() in _RESERVED or pair.name.startswith("."):
            raise InputError(f"{pair.where}: a pair cannot be called {pair.name}, which the results need; rename it")


def _between(pair: PairSpec) -> str:
    ends = [str(pair.files[side]) for side in ("moving", "fixed") if side in pair.files]
    return " to ".join(ends) or pair.name


def _resolver(cohort: Cohort) -> Callable[[PairSpec], RegistrationSettings]:
    """Return a function that completes the settings of a pair; pairs with equal settings share one object."""
    known: dict[str, RegistrationSettings] = {}

    def resolve(pair: PairSpec) -> RegistrationSettings:
        key = json.dumps(pair.settings, sort_keys=True, default=str)
        if key not in known:
            try:
                known[key] = cohort.resolve(pair.settings)
            except InputError as error:
                raise InputError(f"{pair.where}: {error}") from error
        return known[key]

    return resolve


def _missing(pair: PairSpec) -> str:
    """Return a sentence about the files that a pair lacks, empty if there are all."""
    for key, path in pair.files.items():
        try:
            require_name(path)
            if not os.path.exists(path):  # noqa: PTH110 - Path.exists raises if a folder may not be read
                return f"{key} {path} does not exist; check {pair.where}"
            require_file(path, _WHAT.get(key.rpartition("_")[2], "image file"), folder=True)
        except InputError as error:
            return f"{key} {error}; see {pair.where}"
    for what in PAIRED:
        given = [side for side in ("fixed", "moving") if f"{side}_{what}" in pair.files]
        if len(given) == 1:
            other = {"fixed": "moving", "moving": "fixed"}[given[0]]
            return f"{given[0]}_{what} needs {other}_{what} too, give both or neither; check {pair.where}"
    return ""


def _contradiction(pair: PairSpec, settings: RegistrationSettings) -> str:
    """Return a sentence if the settings of a pair do not go with its files."""
    features, labels = (f"fixed_{what}" in pair.files for what in ("features", "labels"))
    for path in settings.programs:
        try:
            require_file(Path(path), "program of features")
        except InputError as error:
            return f"features: {error}; see {pair.where}"
    if problem := contradiction(settings, features=features, labels=labels):
        return f"{problem}; see {pair.where}"
    return _misnamed_tissue(pair, settings)


def _misnamed_tissue(pair: PairSpec, settings: RegistrationSettings) -> str:
    """Return a sentence if a pair has labels of tissue and its settings say nothing of them, or the other way round."""
    given = TISSUE in pair.files
    if given and not settings.knows_tissue:
        return f"the settings do not say what the labels of tissue are, as tissues: {{1: rigid}} does; see {pair.where}"
    problem = unexplained_tissue(given, settings, "tissue")
    return f"{problem}; see {pair.where}" if problem else ""


def _leading_out(pair: PairSpec, out: Path) -> str:
    """Return a sentence about the folder of a pair if it is not inside of ``out``, empty if it is."""
    place = out / pair.subject / pair.name
    if place.resolve() == out.resolve() or not place.resolve().is_relative_to(out.resolve()):
        return f"its folder {place} leads out of {out}; remove the link there, or choose another out"
    return ""


def _job(pair: PairSpec, cohort: Cohort, settings: RegistrationSettings) -> Job:
    files = PairFiles(**pair.files, out=cohort.out / pair.subject / pair.name)
    names = _submissions(pair) if cohort.layout == "learn2reg" else ()
    submissions = [cohort.out / SUBMISSION / name for name in names]
    return Job(
        name=pair.name,
        files=files,
        settings=settings,
        device=cohort.device,
        memory=cohort.memory,
        report=cohort.report,
        submission=submissions[0] if submissions else None,
        also=tuple(submissions[1:]),
        voxels=pair.voxels and pair.files.keys() >= {*_POINTS},
    )


def _submissions(pair: PairSpec) -> tuple[str, ...]:
    return submission_names(pair.files["fixed"], pair.files["moving"])


def register_job(job: Job, *, callback: Callback | None = None) -> Outcome:
    """Register a pair as `register_files` does, and write the file of its submission if there is one.

    Raises:
        InputError: see `register_files`.
        ComputationError: see `register_files`.
    """
    files = _with_titles(job.files) if job.voxels else job.files
    how = {"device": job.device, "memory": job.memory, "report": job.report}
    outcome = register_files(files, job.settings, **how, overwrite=True, callback=callback)  # the journal knows whose
    if job.submission is not None:
        displacement = read_displacement(outcome.folder / "displacement.nii.gz")
        fixed, moving = read_image(files.fixed), read_image(files.moving)
        write_voxel_displacement(displacement.data, fixed, moving, job.submission)
        for path in job.also:
            _write_again(job.submission, path)
    return outcome


def _write_again(file: Path, name: Path) -> None:
    """Give a file another name, or make a copy of it where a file cannot have two."""
    with atomic_file(name) as new:
        try:
            new.hardlink_to(file)
        except OSError:
            shutil.copyfile(file, new)


def _with_titles(files: PairFiles) -> PairFiles:
    """Write the landmarks into the pair's folder with the titles i, j, k for `read_points`; return the new files."""
    given = {key: path for key, path in files.given().items() if key in _POINTS}
    with atomic_folder(files.out) as folder:
        for key, path in given.items():
            rows = read_text(path, "file of landmarks", legacy=True)
            (folder / f"{key}.csv").write_text(f"i,j,k\n{rows}", encoding="utf-8")
    return replace(files, **{key: files.out / f"{key}.csv" for key in given})
