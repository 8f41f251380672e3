"""Worker processes on this machine: a call that dies, hangs or fills the memory costs itself only."""

import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from cohort_files import results

from torchdeform.cohort.executors import local
from torchdeform.cohort.executors.local import LocalExecutor, environment, open_local, usable_cores, visible_gpus
from torchdeform.cohort.run import run
from torchdeform.cohort.settings import EngineSettings
from torchdeform.cohort.summary import log_of
from torchdeform.cohort.task import Task
from torchdeform.core.worker import TimeLimit, Worker, WorkerLost
from torchdeform.errors import ComputationError


@pytest.fixture(scope="module")
def pool() -> Iterator[LocalExecutor]:
    """Two workers, whose calls may take as long as a call can take here."""
    with LocalExecutor([Worker({"OMP_NUM_THREADS": "3"}) for _ in range(2)], timeout=300.0) as executor:
        yield executor


def gone(pid: int) -> bool:
    """Whether a process ends within a minute."""
    for _ in range(1200):
        try:
            state = (
                Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()[0]
            )
        except OSError:
            return True
        if state == "Z":
            return True
        time.sleep(0.05)
    return False


def test_calls_return_values_and_raise_errors(pool):
    assert [pool.submit(math.sqrt, x).result() for x in (4.0, 9.0)] == [2.0, 3.0]
    with pytest.raises(ValueError, match="math domain"):
        pool.submit(math.sqrt, -1.0).result()


def test_workers_are_processes_of_their_own_and_are_kept(pool):
    pids = {pool.submit(os.getpid).result() for _ in range(6)}
    assert os.getpid() not in pids
    assert len(pids) <= 2


def test_workers_have_their_environment(pool):
    assert pool.submit(os.getenv, "OMP_NUM_THREADS").result() == "3"


@pytest.mark.parametrize(
    ("function", "argument", "sentence"),
    [
        (os._exit, 3, "ended with exit code 3"),
        (signal.raise_signal, signal.SIGKILL, "memory ran out"),
        (signal.raise_signal, signal.SIGSEGV, "crashed with signal 11"),
    ],
)
def test_a_call_that_dies_costs_itself_only(pool, function, argument, sentence):
    others = [pool.submit(math.sqrt, float(x)) for x in range(4)]
    lost = pool.submit(function, argument)
    later = [pool.submit(math.sqrt, float(x)) for x in range(4)]
    with pytest.raises(WorkerLost, match=sentence):
        lost.result()
    assert [future.result() for future in others + later] == [math.sqrt(x) for x in range(4)] * 2


def test_a_call_that_hangs_is_given_up():
    start = time.monotonic()
    with LocalExecutor([Worker()], timeout=2.0) as executor:
        with pytest.raises(TimeLimit, match="stopped after 2 seconds"):
            executor.submit(time.sleep, 600.0).result()
        assert time.monotonic() - start < 300
        assert executor.submit(math.sqrt, 4.0).result() == 2.0


def test_an_answer_that_cannot_be_sent_is_an_error(pool):
    with pytest.raises(ComputationError, match="cannot be sent"):
        pool.submit(threading.Lock).result()


def test_shutdown_now_ends_what_runs_and_cancels_what_waits():
    executor = LocalExecutor([Worker()])
    pid = executor.submit(os.getpid).result()
    running, waiting = executor.submit(time.sleep, 600.0), executor.submit(time.sleep, 600.0)
    while not running.running():
        time.sleep(0.01)
    executor.shutdown(cancel_futures=True)
    assert waiting.cancelled()
    assert isinstance(running.exception(), ComputationError)
    assert gone(pid)
    with pytest.raises(RuntimeError, match="shut down"):
        executor.submit(math.sqrt, 1.0)


def test_workers_end_when_their_parent_is_killed():
    code = (
        "import os, time; from torchdeform.cohort.executors.local import LocalExecutor\n"
        "from torchdeform.core.worker import Worker\n"
        "pool = LocalExecutor([Worker()])\n"
        "print(pool.submit(os.getpid).result(), flush=True)\n"
        "pool.submit(time.sleep, 600.0).result()\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    parent.kill()
    parent.communicate()
    assert gone(worker)


def test_workers_auto_fit_cores_gpus_and_memory(monkeypatch):
    monkeypatch.setattr(local, "usable_cores", lambda: 8)
    monkeypatch.setattr(local, "available", lambda: 10_000)
    assert local._fitting([10] * 100, []) == 8
    assert local._fitting([10] * 3, []) == 3
    assert local._fitting([10, 3_000], []) == 2
    assert local._fitting([10, 3_000, 10, 10, 10], []) == 3
    assert local._fitting([20_000] * 5, []) == 1
    assert local._fitting([10] * 100, ["0", "1"]) == 2
    assert local._fitting([0] * 9, []) == 8


def test_each_worker_has_its_gpu_and_threads():
    assert environment(0) == {}
    assert environment(4)["OMP_NUM_THREADS"] == "4"
    assert [environment(1, slot=slot, gpus=["2", "5"])["CUDA_VISIBLE_DEVICES"] for slot in range(3)] == ["2", "5", "2"]


def test_gpus_are_those_that_are_visible(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert visible_gpus() == ["0", "1"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "GPU-a, 3")
    assert visible_gpus() == ["GPU-a", "3"]


def test_cores_keep_to_the_quota(monkeypatch):
    monkeypatch.setattr(local, "_quotas", lambda: [1])
    assert usable_cores() == 1
    monkeypatch.setattr(local, "_quotas", lambda: [0])
    assert usable_cores() == 1


def test_the_engine_is_as_described(jobs):
    with open_local(EngineSettings(workers=2, threads=3, timeout=7), jobs) as engine:
        task = Task(jobs[0], jobs[0].files.out / "log")
        assert engine.executor(task.job).submit(os.getenv, "OMP_NUM_THREADS").result() == "3"
        assert engine.window >= 2


def test_broken_pairs_fail_alone_with_their_sentence_and_log(jobs, tmp_path):
    missing = replace(jobs[1], files=replace(jobs[1].files, fixed=tmp_path / "missing.png"))
    (tmp_path / "text.png").write_text("no image", encoding="ascii")
    text = replace(jobs[2], files=replace(jobs[2].files, moving=tmp_path / "text.png"))
    out = tmp_path / "out"
    summary = run([jobs[0], missing, text, jobs[3]], out, EngineSettings(workers=2, threads=1))
    assert summary.done == 2
    why = {failure.name: failure.sentence for failure in summary.failures}
    assert why.keys() == {"b", "c"}
    assert "missing.png" in why["b"]
    assert "text.png" in why["c"]
    assert why["c"] in log_of(out, "c").read_text(encoding="utf-8")
    assert results(jobs[0]) == results(jobs[3])
    assert not missing.files.out.exists()
