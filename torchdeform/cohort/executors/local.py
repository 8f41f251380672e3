"""The engine of this machine: worker processes with one pair at a time in each."""

import os
import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchdeform.cohort.estimate import measure
from torchdeform.cohort.plan import Job
from torchdeform.cohort.settings import EngineSettings
from torchdeform.cohort.task import PairReport, Task, perform
from torchdeform.core.memory import available
from torchdeform.core.worker import Worker

Answer = PairReport | Exception


@dataclass(frozen=True)
class Engine:
    """Where pairs run.

    Attributes:
        executor: the executor for a job, by what the job needs.
        window: number of jobs that are submitted at a time.
        function: what the executor calls with a task; it may return an error instead of raising it.
        arguments: further arguments of that function.
    """

    executor: Callable[[Job], Executor]
    window: int
    function: Callable[..., Answer] = perform
    arguments: tuple[object, ...] = ()

    def submit(self, task: Task) -> Future[Answer]:
        """Submit a pair."""
        return self.executor(task.job).submit(self.function, task, *self.arguments)


_AHEAD = 4  # pairs in the queue per worker
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS")
_GPUS = "CUDA_VISIBLE_DEVICES"


class LocalExecutor(Executor):
    """Makes calls in worker processes. A call that kills its process fails alone.

    Args:
        workers: the processes, each busy with one call at a time.
        timeout: limit of a call in seconds, None without a limit.

    Notes:
        `concurrent.futures.ProcessPoolExecutor` fails as a whole when one of its processes dies, and cannot stop a
        call that hangs.
    """

    def __init__(self, workers: Sequence[Worker], timeout: float | None = None) -> None:
        self._workers, self._timeout = tuple(workers), timeout
        self._calls: queue.SimpleQueue[tuple[Future[Any], Callable[..., Any], tuple[Any, ...]] | None]
        self._calls = queue.SimpleQueue()
        self._closed = False
        self._threads = [threading.Thread(target=self._serve, args=(w,), daemon=True) for w in self._workers]
        for thread in self._threads:
            thread.start()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return the future of ``fn(*args)``; see `Worker.call` for its errors."""
        if self._closed:
            raise RuntimeError("the executor is shut down")
        if kwargs:
            raise TypeError("calls take positional arguments only")
        future: Future[Any] = Future()
        self._calls.put((future, fn, args))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes: after the last call, or at once with their calls (``cancel_futures``)."""
        self._closed = True
        if cancel_futures:
            self._cancel()
        for _ in self._threads:
            self._calls.put(None)
        if wait:
            for thread in self._threads:
                thread.join()

    def _cancel(self) -> None:
        with suppress(queue.Empty):
            while True:
                if (call := self._calls.get_nowait()) is not None:
                    call[0].cancel()
        for worker in self._workers:
            worker.stop()

    def _serve(self, worker: Worker) -> None:
        while (call := self._calls.get()) is not None:
            future, function, args = call
            if future.set_running_or_notify_cancel():
                self._settle(future, worker, function, args)
            del call, future  # or the result would stay in memory until the next call
        worker.stop()

    def _settle(self, future: Future[Any], worker: Worker, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
        try:
            future.set_result(worker.call(function, *args, timeout=self._timeout))
        except Exception as error:  # noqa: BLE001 - the future raises it
            future.set_exception(error)


@contextmanager
def open_local(settings: EngineSettings, jobs: Sequence[Job]) -> Iterator[Engine]:
    """Yield the engine of this machine for these jobs. Its processes end with the block."""
    gpus = visible_gpus() if any(job.device != "cpu" for job in jobs) else []
    count = settings.workers if settings.workers != "auto" else _fitting(measure(jobs), gpus)
    threads = settings.threads if settings.threads != "auto" else max(1, usable_cores() // count)
    workers = [Worker(environment(threads, slot=slot, gpus=gpus)) for slot in range(min(count, len(jobs)))]
    executor = LocalExecutor(workers, settings.timeout)
    try:
        yield Engine(lambda _: executor, _AHEAD * len(workers))
    finally:
        executor.shutdown(cancel_futures=True)


def _fitting(needs: Sequence[int], gpus: Sequence[str]) -> int:
    """Return how many pairs may run at a time: one per GPU or core, and no more than fit into memory."""
    free = available()
    room = len(needs) if free is None or max(needs) == 0 else free // max(needs)
    return max(1, min(len(gpus) or usable_cores(), len(needs), room))


def environment(threads: int, *, slot: int = 0, gpus: Sequence[str] = ()) -> dict[str, str]:
    """Return the environment of a worker: its threads (0 leaves them as they are), and its own GPU if there is one."""
    counts = dict.fromkeys(_THREADS, str(threads)) if threads else {}
    return counts | ({_GPUS: gpus[slot % len(gpus)]} if gpus else {})


def visible_gpus() -> list[str]:
    """Return the GPUs that this process may use, by their names in ``CUDA_VISIBLE_DEVICES``."""
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    named = [name.strip() for name in os.environ.get(_GPUS, "").split(",") if name.strip()]
    return (named or [str(index) for index in range(count)])[:count]


def usable_cores() -> int:
    """Return the cores that this process may use, by its affinity and by the quota of its control group."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min([cores, *_quotas()]))


def _quotas() -> Iterable[int]:
    with suppress(OSError, ValueError):
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text(encoding="ascii").split()
        if quota != "max":
            yield int(quota) // int(period)
