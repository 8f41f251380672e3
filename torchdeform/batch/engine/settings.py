"""Settings of the engine that runs a cohort's pairs."""

from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, ValidationInfo, model_validator

from torchdeform.batch.strict import Size, Strict, expand, place
from torchdeform.errors import InputError

Count = Annotated[int, Field(ge=1)]
Seconds = Annotated[float, Field(gt=0)]


def _scheduler(value: object, info: ValidationInfo) -> object:
    """Return the address of a scheduler with its variables filled in, or the whole path of a scheduler file."""
    if not isinstance(value, str):
        return value
    text = expand(value)
    return str(place(value, info)) if text.endswith(".json") else text


Scheduler = Annotated[str, BeforeValidator(_scheduler)]


class ClusterSettings(Strict):
    """A cluster that is started for the run and stopped after it."""

    kind: Literal["local", "slurm", "pbs", "lsf"]
    """Who starts the workers: this machine, or a queue by dask-jobqueue."""
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
    """How long a job may last, as the queue writes it, such as 04:00:00; jobs that end are replaced."""
    queue: str | None = None
    """Queue or partition."""
    account: str | None = None
    """Account or project that pays."""
    directives: tuple[str, ...] = ()
    """More options of the queue, such as --constraint=avx2."""
    prologue: tuple[str, ...] = ()
    """Shell commands before a worker starts, such as source /shared/env/bin/activate."""
    interface: str | None = None
    """Network interface between jobs and this machine, such as ib0."""
    python: str | None = None
    """Python of the jobs; that of this process if not given."""

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
    """local: processes of this machine. dask: a Dask cluster, by its scheduler or as described."""
    workers: Count | Literal["auto"] = "auto"
    """local: pairs at a time; auto takes what cores, GPUs and memory allow."""
    threads: Count | Literal["auto"] = "auto"
    """Threads of a pair; auto divides the cores among the pairs that run at a time."""
    timeout: Seconds = 14400.0
    """Seconds after which a pair is given up."""
    scheduler: Scheduler | None = None
    """dask: address of a scheduler, such as tcp://10.0.0.1:8786, or the path of its scheduler file, NAME.json."""
    cluster: ClusterSettings | None = None
    """dask: a cluster to start."""

    @model_validator(mode="after")
    def _one_engine(self) -> Self:
        given = [name for name in ("scheduler", "cluster") if getattr(self, name) is not None]
        if self.kind == "local" and given:
            raise InputError(f"{given[0]} stands with kind: dask only")
        if self.kind == "dask" and len(given) != 1:
            raise InputError("kind: dask needs either scheduler (an address) or cluster (what to start)")
        if self.kind == "dask" and self.workers != "auto":
            raise InputError("workers stands with kind: local; a Dask cluster has its own, see cluster.workers")
        return self
