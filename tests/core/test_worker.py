"""One worker process: it is kept for many calls, and one that does not start is told."""

import math
import os

import pytest

from torchdeform.core.worker import EngineError, Worker


def test_a_hundred_calls_on_one_worker():
    """Beside the registration a call costs next to nothing, so no process is started for it."""
    worker = Worker()
    pids = {worker.call(os.getpid, timeout=60.0) for _ in range(100)}
    worker.stop()
    assert len(pids) == 1


def test_processes_that_do_not_start_stop_everything(monkeypatch):
    monkeypatch.setattr("torchdeform.core.worker.sys.executable", "/bin/false")
    monkeypatch.setattr("torchdeform.core.worker.sleep", lambda seconds: None)
    with pytest.raises(EngineError, match="do not start"):
        Worker().call(math.sqrt, 4.0)
