"""The engine of a Dask cluster: one pair at a time on each thread of its workers."""

import itertools
import logging
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchdeform.cohort.estimate import measure
from torchdeform.cohort.executors.local import Engine, environment, usable_cores, visible_gpus
from torchdeform.cohort.plan import Job
from torchdeform.cohort.settings import ClusterSettings, EngineSettings
from torchdeform.cohort.task import PairReport, Task, perform
from torchdeform.core.memory import readable
from torchdeform.core.worker import EngineError, Worker
from torchdeform.errors import InputError

if TYPE_CHECKING:
    from distributed import Client

# Names of the resources that a worker declares, as ``dask worker --resources "MEMORY=16e9 GPU=1"``.
MEMORY, GPU = "MEMORY", "GPU"

# Pairs submitted at a time: per worker thread, at least, and to a cluster whose number of workers changes.
_AHEAD, _LEAST, _MANY = 2, 64, 1024
_CONNECT = "20s"

_own = threading.local()
_slots = itertools.count()


@contextmanager
def open_dask(settings: EngineSettings, jobs: Sequence[Job], logs: Path) -> Iterator[Engine]:
    """Yield the engine of a Dask cluster for these jobs. A cluster that is started for them stops with the block.

    Args:
        settings: of kind ``dask``.
        jobs: what will run.
        logs: folder for the output of the queue's jobs.

    Raises:
        InputError: Dask is not installed.
        EngineError: the scheduler does not answer.
    """
    try:
        import distributed
    except ImportError as error:
        raise InputError("engine kind dask needs Dask: pip install 'torchdeform[dask]'") from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what goes wrong, `run` says in a sentence
    needs = dict(zip((job.name for job in jobs), measure(jobs), strict=True))
    with ExitStack() as stack:
        cluster = settings.cluster
        where = settings.scheduler if cluster is None else stack.enter_context(start(cluster, logs))
        client = stack.enter_context(_connect(distributed.Client, where))
        declared = declared_by(client) if cluster is None else declared_of(cluster)
        window = max(_LEAST, _AHEAD * cluster.jobs * cluster.workers) if cluster else _MANY
        how = (settings.timeout, _threads(settings))
        yield Engine(_executors(client, needs, declared), window, isolated, how)


def _threads(settings: EngineSettings) -> int:
    """Return the threads of a pair, 0 if its worker must find out."""
    if settings.threads != "auto":
        return settings.threads
    return settings.cluster.cores // settings.cluster.workers if settings.cluster else 0


def isolated(task: Task, timeout: float, threads: int) -> PairReport | Exception:
    """Run a task in the process of this thread of a Dask worker, so that it can be killed alone.

    Args:
        task: the pair.
        timeout: limit in seconds.
        threads: of the process; 0 divides the cores of the machine among the threads of the Dask worker.

    Returns:
        The report, or the error about the process; of an error that is raised Dask prints the traceback.
    """
    try:
        return _own_worker(threads or _share(), task.job.device != "cpu").call(perform, task, timeout=timeout)
    except Exception as error:  # noqa: BLE001 - the run raises it
        return error


def _own_worker(threads: int, gpu: bool) -> Worker:
    """Return the process of this thread, a new one if the last one had other settings."""
    if getattr(_own, "settings", None) != (threads, gpu):
        if hasattr(_own, "worker"):
            _own.worker.stop()
        if not hasattr(_own, "slot"):
            _own.slot = next(_slots)
        _own.settings = threads, gpu
        _own.worker = Worker(environment(threads, slot=_own.slot, gpus=visible_gpus() if gpu else ()))
    return _own.worker


def _share() -> int:
    from distributed import get_worker

    return max(1, usable_cores() // get_worker().state.nthreads)


def _connect(kind: "type[Client]", where: Any) -> "Client":
    in_file = isinstance(where, str) and Path(where).suffix == ".json"
    try:
        if in_file:
            return kind(scheduler_file=where, timeout=_CONNECT, set_as_default=False)
        return kind(where, timeout=_CONNECT, set_as_default=False)
    except (OSError, ValueError) as error:
        text = f"the Dask scheduler {where} does not answer; check engine.scheduler, and start it"
        raise EngineError(text) from error


def _executors(client: "Client", needs: Mapping[str, int], declared: Mapping[str, float]) -> Any:
    """Return a function from a job to its executor, which asks for the job's memory and GPU if workers have them."""

    @cache
    def executor(resources: tuple[tuple[str, float], ...]) -> Executor:
        return client.get_executor(pure=False, resources=dict(resources))

    def choose(job: Job) -> Executor:
        asked = {MEMORY: needs[job.name], GPU: 1 if job.device != "cpu" else 0}
        # A pair that is too large for every worker runs alone on one, and fails there with a sentence.
        needed = {name: min(asked[name], most) for name, most in declared.items() if name in asked}
        return executor(tuple(sorted((name, amount) for name, amount in needed.items() if amount)))

    return choose


def declared_by(client: "Client") -> dict[str, float]:
    """Return the largest amount of every resource that all workers of a scheduler declare; waits for a worker."""
    client.wait_for_workers(1)
    workers = [info["resources"] for info in client.scheduler_info(n_workers=-1)["workers"].values()]
    common = set.intersection(*map(set, workers))
    return {name: max(resources[name] for resources in workers) for name in common}


def declared_of(cluster: ClusterSettings) -> dict[str, float]:
    """Return the resources of each worker of a cluster in the cohort file."""
    gpus = {GPU: float(cluster.gpus)} if cluster.gpus else {}
    return {MEMORY: float(cluster.memory)} | gpus


def start(cluster: ClusterSettings, logs: Path) -> Any:
    """Start a cluster and return it; it is a context manager that stops it.

    Raises:
        InputError: a queue without dask-jobqueue being installed.
    """
    if cluster.kind == "local":
        from distributed import LocalCluster

        with _ignoring_interrupts():
            return LocalCluster(
                n_workers=cluster.jobs,
                threads_per_worker=cluster.workers,
                memory_limit=0,
                silence_logs=logging.CRITICAL,
                resources=declared_of(cluster),
                dashboard_address="127.0.0.1:0",  # any free port, visible on this machine only
            )
    queue = make_queue(cluster, logs)
    queue.adapt(
        minimum_jobs=cluster.jobs, maximum_jobs=cluster.jobs
    )  # replaces jobs that have reached their time limit
    return queue


@contextmanager
def _ignoring_interrupts() -> Iterator[None]:
    """Start processes in this block so that they ignore Ctrl-C; this process ends them in order."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    earlier = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, earlier)


def make_queue(cluster: ClusterSettings, logs: Path) -> Any:
    """Return a cluster of dask-jobqueue, still without workers."""
    try:
        import dask_jobqueue
    except ImportError as error:
        raise InputError(f"cluster {cluster.kind} needs dask-jobqueue: pip install 'torchdeform[dask]'") from error
    name, own = {
        "slurm": ("SLURMCluster", _slurm),
        "pbs": ("PBSCluster", _pbs),
        "lsf": ("LSFCluster", _lsf),
    }[cluster.kind]
    resources = ",".join(f"{key}={amount:.0f}" for key, amount in declared_of(cluster).items())
    specific = own(cluster)
    return getattr(dask_jobqueue, name)(
        cores=cluster.workers,
        processes=1,
        memory=f"{cluster.memory}B",
        queue=cluster.queue,
        walltime=cluster.walltime,
        interface=cluster.interface,
        python=cluster.python,
        job_name="torchdeform",
        job_script_prologue=list(cluster.prologue),
        job_extra_directives=[*specific.pop("directives"), *cluster.directives],
        worker_extra_args=["--resources", resources],
        log_directory=str(logs),
        scheduler_options={"dashboard_address": ":0"},
        **specific,
    )


def _slurm(cluster: ClusterSettings) -> dict[str, Any]:
    gpus = [f"--gres=gpu:{cluster.gpus}"] if cluster.gpus else []
    return {"job_cpu": cluster.cores, "account": cluster.account, "directives": gpus}


def _pbs(cluster: ClusterSettings) -> dict[str, Any]:
    gpus = f":ngpus={cluster.gpus}" if cluster.gpus else ""
    memory = readable(cluster.memory, spaced=False).lower()
    spec = f"select=1:ncpus={cluster.cores}{gpus}:mem={memory}"
    return {"resource_spec": spec, "account": cluster.account, "directives": []}


def _lsf(cluster: ClusterSettings) -> dict[str, Any]:
    gpus = [f'-gpu "num={cluster.gpus}"'] if cluster.gpus else []
    return {"ncpus": cluster.cores, "project": cluster.account, "directives": gpus}
