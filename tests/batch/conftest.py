"""What these tests share: an engine that does the work in this process, because its real ones have their own tests."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest

from torchdeform.cohort.executors.local import Engine
from torchdeform.cohort.task import DONE, PairReport, Task


def _succeed(task: Task) -> PairReport:
    task.job.files.out.mkdir(parents=True, exist_ok=True)
    (task.job.files.out / "result.json").write_text("{}", encoding="ascii")
    return PairReport(DONE, seconds=0.1, figures={"folds": 0}, files=("result.json",))


@pytest.fixture
def feigned(monkeypatch) -> None:
    """Pairs are done in no time."""

    @contextmanager
    def opened(*_: object) -> Iterator[Engine]:
        with ThreadPoolExecutor(1) as pool:
            yield Engine(lambda _: pool, 2, _succeed)

    monkeypatch.setattr("torchdeform.cohort.run._open", opened)
