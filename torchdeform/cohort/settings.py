"""Parts of the cohort file: types of paths, patterns and sizes, and the settings of the engine and of a template."""

import os
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from string import Template
from typing import Annotated, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, ValidationInfo, model_validator

from torchdeform.cohort.patterns import literal, part_names
from torchdeform.core.memory import parse_size
from torchdeform.errors import InputError, shown
from torchdeform.registration.template import AveragingSettings, Pose

_LONGEST_PATH = 4096  # characters


class Strict(BaseModel):
    """A frozen record that refuses unknown keys and values of another type."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


def expand(text: str) -> str:
    """Return a text with ``$VAR`` and ``${VAR}`` replaced by the environment's values; ``$$`` is a dollar sign.

    Raises:
        InputError: a variable that is not set.
    """
    return _substitute(text, str)


def expand_pattern(text: str) -> str:
    """Return a pattern expanded as by `expand`; the values of the variables are no patterns."""
    return _substitute(text, literal)


def _substitute(text: str, form: Callable[[str], str]) -> str:
    if "$" not in text:
        return text
    try:
        return Template(text).substitute({name: form(value) for name, value in os.environ.items()})
    except KeyError as error:
        raise InputError(f"the environment variable {error.args[0]} is not set; set it, or write the path") from error
    except ValueError as error:
        raise InputError(f"{shown(text)} has a $ without the name of a variable; write $$ for a dollar sign") from error


def _folder(info: ValidationInfo) -> Path:
    """Return the folder of the cohort file; its paths are relative to it."""
    return (info.context or {}).get("folder", Path())


def _text(value: object) -> str:
    if not isinstance(value, str | Path) or not str(value):
        raise InputError(f"a path is a text, got {shown(value)}")
    return str(value)


def place(value: object, info: ValidationInfo) -> Path:
    """Return the absolute path for a text of the file."""
    return absolute_path(_folder(info), expand(_text(value)))


def pattern(value: object, info: ValidationInfo) -> str:
    """Return the absolute pattern for a text of the file."""
    text = expand_pattern(_text(value))
    part_names(text)
    return absolute_path(Path(literal(_folder(info).as_posix())), text).as_posix()


def absolute_path(folder: Path, text: str) -> Path:
    """Return an absolute path as it is, another one below ``folder``; ``../`` at the start goes up from there.

    Raises:
        InputError: longer than any path can be, or ``~`` of a user that is not known.
    """
    if len(text) > _LONGEST_PATH:
        raise InputError(f"{shown(text)} is longer than a path can be; check it")
    try:
        path = Path(text).expanduser()
    except RuntimeError as error:
        raise InputError(f"{shown(text)}: there is no user of this name, or no home folder; write the path") from error
    while path.parts[:1] == ("..",):
        folder, path = folder.parent, Path(*path.parts[1:])
    return folder / path


def _size(value: object) -> object:
    return parse_size(value) if isinstance(value, str) else value


def _scheduler(value: object, info: ValidationInfo) -> object:
    """Return the address of a scheduler with its variables filled in, or the absolute path of a scheduler file."""
    if not isinstance(value, str):
        return value
    text = expand(value)
    return str(place(value, info)) if text.endswith(".json") else text


_written = PlainSerializer(lambda value: str(value).replace("$", "$$"), return_type=str, when_used="json")

Place = Annotated[Path, BeforeValidator(place), _written]
Pattern = Annotated[str, BeforeValidator(pattern), _written]
Size = Annotated[int, BeforeValidator(_size), Field(gt=0)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
Seconds = Annotated[float, Field(gt=0, le=1e9)]
Scheduler = Annotated[str, BeforeValidator(_scheduler)]


class ClusterSettings(Strict):
    """A cluster that starts and stops with the run."""

    kind: Literal["local", "slurm", "pbs", "lsf"]
    """Where the workers run: on this machine, or in a queue by dask-jobqueue."""
    jobs: Count = 1
    """Jobs in the queue at a time, each with a worker process; worker processes, on a local cluster."""
    workers: Count = 1
    """Pairs that a job registers at a time."""
    cores: Count = 1
    """Cores of a job, divided among its pairs."""
    memory: Size = 8_000_000_000
    """Memory of a job, such as 16GB, shared by its pairs."""
    gpus: Annotated[int, Field(ge=0)] = 0
    """GPUs of a job; each pair takes one."""
    walltime: str | None = None
    """Time limit of a job in the queue's notation, such as 04:00:00; jobs that end are replaced."""
    queue: str | None = None
    """Queue or partition."""
    account: str | None = None
    """Account or project to charge."""
    directives: tuple[str, ...] = ()
    """More options of the queue, such as --constraint=avx2."""
    prologue: tuple[str, ...] = ()
    """Shell commands before a worker starts, such as source /shared/env/bin/activate."""
    interface: str | None = None
    """Network interface between jobs and this machine, such as ib0."""
    python: str | None = None
    """Python of the jobs; by default that of this process."""

    @model_validator(mode="after")
    def _divisible(self) -> Self:
        if self.gpus and self.workers > self.gpus:
            raise InputError(f"workers: each pair takes a GPU, so there can be {self.gpus} at most, got {self.workers}")
        if self.workers > self.cores:
            raise InputError(f"workers: {self.workers} pairs at a time need as many cores, and cores is {self.cores}")
        return self


class EngineSettings(Strict):
    """Where and how the pairs run."""

    kind: Literal["local", "dask"] = "local"
    """local: processes of this machine. dask: a Dask cluster, by its scheduler or as given in cluster."""
    workers: Count | Literal["auto"] = "auto"
    """local: pairs at a time; auto: as many as cores, GPUs and memory allow."""
    threads: Count | Literal["auto"] = "auto"
    """Threads of a pair; auto: the cores divided among the pairs that run at a time."""
    timeout: Seconds = 14400.0
    """Seconds after which a pair is stopped."""
    scheduler: Scheduler | None = None
    """dask: address of a scheduler, such as tcp://10.0.0.1:8786, or the path of its scheduler file, NAME.json."""
    cluster: ClusterSettings | None = None
    """dask: a cluster to start."""

    @model_validator(mode="after")
    def _one_engine(self) -> Self:
        given = [name for name in ("scheduler", "cluster") if getattr(self, name) is not None]
        if self.kind == "local" and given:
            raise InputError(f"{given[0]} is for kind: dask only; remove it, or set kind: dask")
        if self.kind == "dask" and len(given) != 1:
            raise InputError("kind: dask needs either scheduler (an address) or cluster (what to start)")
        if self.kind == "dask" and self.workers != "auto":
            raise InputError("workers is for kind: local only; for a Dask cluster use cluster.workers")
        return self


class TemplateSettings(Strict):
    """How a template is made."""

    rounds: Count = 3
    """How often all images are registered, each time to the template of the round before."""
    reference: Place | None = None
    """Image that the first round registers to; the template gets its grid. By default the first of images."""
    pose: Pose = AveragingSettings.pose
    """Position and orientation of the template: those of the reference, or the mean of all images."""
    match_intensities: bool = AveragingSettings.match_intensities
    """Scale all images to one mean and one standard deviation before they are averaged."""
    corrections: Count = AveragingSettings.corrections
    """Corrections in a round at most that bring the mean of the maps from the template to the identity."""
    tolerance: Annotated[float, Field(ge=0, le=1e9)] = AveragingSettings.tolerance
    """Largest displacement of that mean, in voxels, that counts as the identity."""

    @property
    def averaging(self) -> AveragingSettings:
        """The settings for the averages of a round."""
        return AveragingSettings(**{field.name: getattr(self, field.name) for field in fields(AveragingSettings)})
