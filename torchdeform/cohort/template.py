"""A template of image files: in each round all images are registered and averaged; the last round is published."""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

from torchdeform.cohort.journal import Journal
from torchdeform.cohort.pairs import named_images
from torchdeform.cohort.plan import Job
from torchdeform.cohort.run import Event, run
from torchdeform.cohort.schema import Cohort
from torchdeform.cohort.summary import Failure
from torchdeform.core.diagnostics import diagnose
from torchdeform.core.image import AUTO, Image
from torchdeform.core.transform import Displacement, Transform
from torchdeform.core.warp import compose
from torchdeform.errors import ComputationError, InputError
from torchdeform.io import read_image, read_transform, write_image, write_transform
from torchdeform.io.files import atomic_folder, remove_leftovers, require_writable
from torchdeform.io.gate import require_file
from torchdeform.io.images import ending_like, read_labels, write_labels
from torchdeform.io.texts import read_json
from torchdeform.pipeline.register import PairFiles, choose_device
from torchdeform.registration.settings import FILES
from torchdeform.registration.template import Lazy, Template, identity_map, make_template
from torchdeform.report.figures import write_gallery
from torchdeform.report.record import describe_map, versions, write_json

TEMPLATE, OVERVIEW, RECORD = "template.nii.gz", "overview.png", "result.json"
SUBJECTS, ROUNDS = "subjects", "rounds"

_TRANSFORM, _INVERSE, _WARPED = "transform.h5", "inverse.h5", "warped"
_ROUND, _PAIRS = "round.json", "pairs"
_FEWEST = 2  # images

Listener = Callable[[int, Event], None]


@dataclass(frozen=True)
class Subject:
    """An image of a template: its name and its files."""

    name: str
    image: Path
    mask: Path | None = None
    labels: Path | None = None


@dataclass(frozen=True)
class Built:
    """The results of a template.

    Attributes:
        folder: of the results.
        record: the content of ``result.json``.
        failures: images that could not be registered, and why.
    """

    folder: Path
    record: Mapping[str, Any]
    failures: tuple[Failure, ...]


@dataclass(frozen=True)
class Round:
    """One round.

    Attributes:
        number: from 1.
        folder: of its registrations and its template.
        reference: the image that all others are registered to.
        subjects: the images of the round.
        key: a hash of everything that its template depends on.
    """

    number: int
    folder: Path
    reference: Path
    subjects: tuple[Subject, ...]
    key: str


def build(cohort: Cohort, *, retry_failed: bool = False, report: Listener | None = None) -> Built:
    """Make the template of a cohort's images; work of an earlier run is not repeated.

    Writes into ``cohort.out``: ``template.nii.gz``, ``overview.png`` and ``result.json``; for each image
    ``subjects/NAME/`` with ``transform.h5`` (maps points of the template to the image and warps the image onto the
    template), ``inverse.h5`` (the other way) and ``warped.*``; and ``rounds/N/`` with the results of each round.

    Args:
        cohort: with ``images``.
        retry_failed: also register images that failed in an earlier run.
        report: is called with the number of the round and every event of its run.

    Raises:
        InputError: no images, fewer than two, or a folder that cannot be written.
        ComputationError: fewer than two images could be registered, or no mean shape without folds was found.

    Notes:
        An image that cannot be registered in one round is left out of this round and of all later ones.
    """
    subjects = _subjects(cohort)
    _require_for_templates(cohort)
    require_writable(cohort.out)
    for place in (cohort.out / SUBJECTS, *(cohort.out / SUBJECTS).glob("*")):
        remove_leftovers(place)
    reference, failures, rounds = cohort.template.reference or subjects[0].image, [], []
    template, current = None, None
    for number in range(1, cohort.template.rounds + 1):
        current, failed = _register(cohort, number, reference, subjects, retry_failed, report)
        template = _average(current, cohort)
        reference, subjects = current.folder / TEMPLATE, current.subjects
        failures += failed
        rounds.append(current)
    return Built(cohort.out, _publish(rounds, template, cohort, failures), tuple(failures))


def _require_for_templates(cohort: Cohort) -> None:
    """Raise `InputError` if the settings ask for what a template has not, or for a program that is not there."""
    settings = cohort.resolve()
    pairs = {
        "tissues and sliding": settings.knows_tissue,
        "labels that pull (labels_weight)": settings.labels_weight > 0,
        "features: files": FILES in settings.sources,
    }
    for what, asked in pairs.items():
        if asked:
            raise InputError(f"{cohort.path}: settings: {what} are for pairs, a template has none; remove them")
    for program in settings.programs:
        try:
            require_file(Path(program), "program of features")
        except InputError as error:
            raise InputError(f"{cohort.path}: settings: features: {error}") from error


def _subjects(cohort: Cohort) -> tuple[Subject, ...]:
    found = tuple(
        Subject(name, files["image"], files.get("mask"), files.get("labels"))
        for name, files in named_images(cohort).items()
    )
    if len(found) < _FEWEST:
        raise InputError(f"{cohort.path}: a template needs at least {_FEWEST} images, got {len(found)}; check images")
    return found


def _register(
    cohort: Cohort,
    number: int,
    reference: Path,
    subjects: Sequence[Subject],
    retry_failed: bool,
    report: Listener | None,
) -> tuple[Round, tuple[Failure, ...]]:
    """Register all images but the reference to it; return the round of those that succeeded, and the failures."""
    folder = cohort.out / ROUNDS / str(number)
    jobs = {subject: _job(cohort, folder, reference, subject) for subject in subjects}
    others = [job for subject, job in jobs.items() if subject.image != reference]
    listen = None if report is None else lambda event: report(number, event)
    summary = run(others, folder, cohort.engine, retry_failed=retry_failed, report=listen)
    missing = {failure.name for failure in summary.failures}
    left = {subject: job for subject, job in jobs.items() if subject.name not in missing}
    if len(left) < _FEWEST:
        why = f": {summary.failures[0].sentence}" if summary.failures else ""
        raise ComputationError(f"round {number}: a template needs {_FEWEST} images, and {len(left)} are left{why}")
    key = _key(cohort, folder, left.values())
    return Round(number, folder, reference, tuple(left), key), summary.failures


def _job(cohort: Cohort, folder: Path, reference: Path, subject: Subject) -> Job:
    out = folder / _PAIRS / subject.name
    files = PairFiles(fixed=reference, moving=subject.image, moving_mask=subject.mask, out=out)
    return Job(name=subject.name, files=files, settings=cohort.resolve(), device=cohort.device, memory=cohort.memory)


def _key(cohort: Cohort, folder: Path, jobs: Iterable[Job]) -> str:
    """Return a hash of all images and of how they are registered and averaged."""
    with Journal(folder) as journal:
        fingerprints = {job.name: journal.fingerprint(job) for job in jobs}
    text = json.dumps([fingerprints, asdict(cohort.template.averaging)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _average(current: Round, cohort: Cohort) -> Template | None:
    """Make and write the template of a round; None if an earlier run did."""
    if _recorded(current.folder / _ROUND, current.key) and (current.folder / TEMPLATE).is_file():
        return None
    start = perf_counter()
    template = _make(current, cohort)
    record = {
        "key": current.key,
        "round": current.number,
        "reference": current.reference,
        "images": [subject.name for subject in current.subjects],
        "bias_voxels": template.shape.bias,
        "seconds": perf_counter() - start,
    }
    with atomic_folder(current.folder) as folder:
        write_image(template.image.to("cpu"), folder / TEMPLATE)
        write_json(record, folder / _ROUND)
    return template


def _make(current: Round, cohort: Cohort) -> Template:
    """Average the images and maps of a round, one image and one map in memory at a time."""
    where, subjects = choose_device(cohort.device), current.subjects
    reference = read_image(current.reference).to(where)
    images = Lazy(len(subjects), lambda i: read_image(subjects[i].image).to(where))
    maps = Lazy(len(subjects), lambda i: _read_map(current, subjects[i], reference))
    return make_template(images, maps, reference, cohort.template.averaging)


def _read_map(current: Round, subject: Subject, reference: Image) -> Transform:
    """Return the map from the reference to an image, with its inverse."""
    if subject.image == current.reference:
        return identity_map(reference)
    pair = current.folder / _PAIRS / subject.name
    forward, back = (read_transform(pair / name).stages for name in (_TRANSFORM, _INVERSE))
    fields = [stage.field for stage in (forward[0], back[-1]) if isinstance(stage, Displacement)]
    first, second = (replace(field, data=field.data.float()) for field in fields)
    known = Displacement(first, second)
    return Transform((known, *forward[1:]), reference).to(reference.data.device)


def _publish(
    rounds: Sequence[Round], template: Template | None, cohort: Cohort, failures: Sequence[Failure]
) -> Mapping[str, Any]:
    """Write the template of the last round and the maps from it to every image, unless an earlier run did."""
    out, last = cohort.out, rounds[-1]
    earlier = _recorded(out / RECORD, last.key)
    if earlier and all((out / name).is_file() for name in earlier["files"]):
        return earlier
    template = template or _make(last, cohort)
    found = {s.name: _publish_subject(s, template.maps[i], template, out) for i, s in enumerate(last.subjects)}
    record = {
        "key": last.key,
        "images": found,
        "left_out": {failure.name: failure.sentence for failure in failures},
        "rounds": [_recorded(current.folder / _ROUND, current.key) for current in rounds],
        "settings": asdict(cohort.resolve()),
        "template": cohort.template.model_dump(mode="json"),
        "versions": versions(),
        "files": [TEMPLATE, OVERVIEW, *(name for one in found.values() for name in one["files"])],
    }
    gallery = {"reference": rounds[0].reference} | {f"round {r.number}": r.folder / TEMPLATE for r in rounds}
    with atomic_folder(out) as folder:
        write_image(template.image.to("cpu"), folder / TEMPLATE)
        write_gallery(folder / OVERVIEW, {title: read_image(path) for title, path in gallery.items()})
        write_json(record, folder / RECORD)
    return record


def _publish_subject(subject: Subject, from_template: Transform, template: Template, out: Path) -> dict[str, Any]:
    """Write the map of an image and the image on the template; return its files, folds and determinants."""
    place = Path(SUBJECTS) / subject.name
    image, map_ = read_image(subject.image), from_template.to("cpu")
    warped = replace(map_.image(image, template.image.to("cpu"), outside=AUTO), pixel_type=image.pixel_type)
    with atomic_folder(out / place) as folder:
        write_transform(map_, folder / _TRANSFORM)
        write_transform(map_.inverse(), folder / _INVERSE)
        write_image(warped, folder / f"{_WARPED}{ending_like(subject.image, warped)}")
        if subject.labels is not None:
            labels = map_.labels(read_labels(subject.labels), template.image.to("cpu"))
            write_labels(labels, folder / f"{_WARPED}_labels{ending_like(subject.labels, labels)}")
        names = sorted(path.name for path in folder.iterdir())
    return {"image": str(subject.image), **_describe_map(map_), "files": [str(place / name) for name in names]}


def _describe_map(map_: Transform) -> dict[str, Any]:
    """Return folds and determinants of a map from the template, without its affine part."""
    back, ahead = (stage.field for stage in map_.stages if isinstance(stage, Displacement))
    return describe_map(diagnose(compose(ahead.data, back.data, back.grid), back.grid))


def _recorded(path: Path, key: str) -> dict[str, Any] | None:
    """Return a record if an earlier run wrote it for the same images and settings."""
    try:
        record = read_json(path, "record of a template")
    except InputError:
        return None
    return record if isinstance(record, dict) and record.get("key") == key else None
