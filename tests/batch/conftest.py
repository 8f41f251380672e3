"""What these tests share: an engine that does the work in this process, because its real ones have their own tests."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest

from torchdeform.cohort.executors.local import Engine
from torchdeform.cohort.task import DONE, PairReport, Task


@pytest.fixture
def feigned(monkeypatch) -> dict[str, Callable[[Task], None]]:
    """Pairs are done in no time; what happens while one of them runs goes into this, by its name."""
    meanwhile: dict[str, Callable[[Task], None]] = {}

    def work(task: Task) -> PairReport:
        task.job.files.out.mkdir(parents=True, exist_ok=True)
        (task.job.files.out / "result.json").write_text("{}", encoding="ascii")
        meanwhile.get(task.job.name, lambda _: None)(task)
        return PairReport(DONE, seconds=0.1, figures={"folds": 0}, files=("result.json",))

    @contextmanager
    def opened(*_: object) -> Iterator[Engine]:
        with ThreadPoolExecutor(1) as pool:
            yield Engine(lambda _: pool, 1, work)

    monkeypatch.setattr("torchdeform.cohort.run._open", opened)
    return meanwhile
