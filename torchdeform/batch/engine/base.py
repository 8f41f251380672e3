"""What every engine is: executors, and how many jobs they are given at a time."""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass

from torchdeform.batch.job import Job
from torchdeform.batch.task import Report, Task, perform


@dataclass(frozen=True)
class Engine:
    """Where pairs run.

    Attributes:
        executor: the executor for a job, by what the job needs.
        window: how many jobs are handed over at a time.
        function: what the executor calls with a task.
        arguments: and with these besides.
    """

    executor: Callable[[Job], Executor]
    window: int
    function: Callable[..., Report] = perform
    arguments: tuple[object, ...] = ()

    def submit(self, task: Task) -> Future[Report]:
        """Hand a pair over."""
        return self.executor(task.job).submit(self.function, task, *self.arguments)
