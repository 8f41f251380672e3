"""The engines: a call that dies, hangs or fills the memory costs itself only; clusters get what is written."""

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
from pydantic import ValidationError

from torchdeform.cohort.estimate import measure
from torchdeform.cohort.executors import local
from torchdeform.cohort.executors.local import LocalExecutor, environment, open_local, usable_cores, visible_gpus
from torchdeform.cohort.executors.worker import EngineError, TimeLimit, Worker, WorkerLost
from torchdeform.cohort.plan import Job
from torchdeform.cohort.run import Event, run
from torchdeform.cohort.settings import ClusterSettings, EngineSettings
from torchdeform.cohort.summary import log_of
from torchdeform.cohort.task import Task
from torchdeform.errors import ComputationError
from torchdeform.io import write_image
from torchdeform.pipeline.register import PairFiles
from torchdeform.registration.settings import RegistrationSettings

FAST = RegistrationSettings(align="none", similarity="ssd", steps=(2,), length=8.0)


@pytest.fixture(scope="module")
def pool() -> Iterator[LocalExecutor]:
    """Two workers, whose calls may take two seconds."""
    with LocalExecutor([Worker({"OMP_NUM_THREADS": "3"}) for _ in range(2)], timeout=2.0) as executor:
        yield executor


@pytest.fixture
def jobs(tmp_path, make_image) -> list[Job]:
    """Four pairs of small images."""
    paths = [tmp_path / "fixed.png", tmp_path / "moving.png"]
    for path, shift in zip(paths, (0.0, 3.0), strict=True):
        write_image(make_image((16, 16), origin=(shift, 0.0), pixel_type="uint8"), path)
    return [
        Job(
            name=name,
            files=PairFiles(fixed=paths[0], moving=paths[1], out=tmp_path / "out" / name),
            settings=FAST,
            device="cpu",
        )
        for name in "abcd"
    ]


def results(job: Job) -> dict[str, bytes]:
    """The files that hold no times: HDF5 keeps when it was written; the displacement is the same as the transform."""
    return {path.name: path.read_bytes() for path in job.files.out.iterdir() if path.suffix in (".png", ".gz")}


def worker_processes() -> list[int]:
    """Processes of the local cluster that this process started."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(stat.read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()[1])
            command = (stat.parent / "cmdline").read_bytes()
        except OSError:
            continue
        if parent == os.getpid() and b"spawn_main" in command:
            found.append(int(stat.parent.name))
    return found


def gone(pid: int) -> bool:
    """Whether a process ends within a few seconds."""
    for _ in range(100):
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


# Processes


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


def test_a_call_that_hangs_is_given_up(pool):
    start = time.monotonic()
    with pytest.raises(TimeLimit, match="given up after 2 seconds"):
        pool.submit(time.sleep, 600.0).result()
    assert time.monotonic() - start < 300
    assert pool.submit(math.sqrt, 4.0).result() == 2.0


def test_an_answer_that_cannot_be_sent_is_an_error(pool):
    with pytest.raises(ComputationError, match="cannot be sent"):
        pool.submit(threading.Lock).result()


def test_a_hundred_calls_on_one_worker():
    """Beside the registration a call costs next to nothing, so no process is started for it."""
    worker = Worker()
    pids = {worker.call(os.getpid, timeout=60.0) for _ in range(100)}
    worker.stop()
    assert len(pids) == 1


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
        "from torchdeform.cohort.executors.worker import Worker\n"
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


def test_processes_that_do_not_start_stop_everything(monkeypatch):
    monkeypatch.setattr("torchdeform.cohort.executors.worker.sys.executable", "/bin/false")
    monkeypatch.setattr("torchdeform.cohort.executors.worker.sleep", lambda seconds: None)
    with pytest.raises(EngineError, match="do not start"):
        Worker().call(math.sqrt, 4.0)


# This machine


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


def test_needs_are_those_of_the_estimate(jobs, tmp_path):
    volume = tmp_path / "missing.nii.gz"
    unknown = replace(jobs[0], files=replace(jobs[0].files, fixed=volume))
    symmetric = replace(jobs[0], settings=replace(FAST, symmetric=True))
    small, limited = replace(jobs[0], memory=10**12), replace(unknown, memory=5)
    one, two, none, same, five = measure([jobs[0], symmetric, unknown, small, limited])
    assert one == same > 4e8
    assert two == 2 * one
    assert (none, five) == (0, 5)


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


# Dask


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"kind": "dask"}, "either scheduler"),
        ({"kind": "dask", "scheduler": "tcp://a:1", "cluster": {"kind": "local"}}, "either scheduler"),
        ({"scheduler": "tcp://a:1"}, "scheduler stands with kind: dask"),
        ({"cluster": {"kind": "local"}}, "cluster stands with kind: dask"),
        ({"kind": "dask", "scheduler": "tcp://a:1", "workers": 2}, "workers stands with kind: local"),
        ({"kind": "dask", "cluster": {"kind": "slurm", "workers": 4, "cores": 2}}, "need as many cores"),
        ({"kind": "dask", "cluster": {"kind": "slurm", "workers": 4, "cores": 8, "gpus": 2}}, "takes a GPU"),
        ({"workers": 0}, "greater than or equal to 1"),
        ({"timeout": 0}, "greater than 0"),
    ],
)
def test_settings_that_contradict_are_refused(settings, sentence):
    with pytest.raises(ValidationError, match=sentence):
        EngineSettings(**settings)


def test_a_scheduler_that_is_not_there_is_named(jobs, tmp_path, monkeypatch):
    dask = pytest.importorskip("torchdeform.cohort.executors.dask")
    pytest.importorskip("distributed")
    monkeypatch.setattr(dask, "_CONNECT", "0.5s")
    monkeypatch.setattr(dask, "_measured", lambda jobs: [0] * len(jobs))
    settings = EngineSettings(kind="dask", scheduler="tcp://127.0.0.1:1")
    with (
        pytest.raises(EngineError, match=r"tcp://127\.0\.0\.1:1 does not answer"),
        dask.open_dask(settings, jobs, tmp_path),
    ):
        pass


@pytest.mark.parametrize(
    ("kind", "lines"),
    [
        (
            "slurm",
            ["#SBATCH --cpus-per-task=8", "#SBATCH --mem=15G", "#SBATCH -p long", "#SBATCH -A lab", "--gres=gpu:2"],
        ),
        ("pbs", ["#PBS -l select=1:ncpus=8:ngpus=2:mem=16gb", "#PBS -q long", "#PBS -A lab", "walltime=01:00:00"]),
        ("lsf", ["#BSUB -n 8", "#BSUB -q long", '#BSUB -P "lab"', '-gpu "num=2"', "#BSUB -W 01:00:00"]),
    ],
)
def test_queues_are_asked_for_what_is_written(kind, lines, tmp_path):
    pytest.importorskip("dask_jobqueue")
    import dask

    from torchdeform.cohort.executors.dask import make_queue

    cluster = ClusterSettings(
        kind=kind,
        workers=2,
        cores=8,
        memory=16_000_000_000,
        gpus=2,
        walltime="01:00:00",
        queue="long",
        account="lab",
        directives=("--more",),
        prologue=("source /shared/env/bin/activate",),
        python="/shared/env/bin/python",
    )
    with dask.config.set({"jobqueue.lsf.lsf-units": "mb"}), make_queue(cluster, tmp_path / "logs") as queue:
        script = queue.job_script()
    for line in [*lines, "--more", "source /shared/env/bin/activate", "/shared/env/bin/python -m distributed"]:
        assert line in script
    assert "--nthreads 2" in script
    assert "--resources MEMORY=16000000000,GPU=2" in script


def test_pairs_ask_for_what_all_workers_declare(jobs):
    distributed = pytest.importorskip("distributed")
    from torchdeform.cohort.executors.dask import _executors, declared_by

    common = {"processes": False, "n_workers": 1, "dashboard_address": "127.0.0.1:0"}
    with (
        distributed.LocalCluster(**common, resources={"MEMORY": 100, "GPU": 2, "DISK": 1}) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        declared = declared_by(client)
        choose = _executors(client, {"a": 30, "b": 300, "c": 0}, declared)
        wanted = [choose(job)._kwargs["resources"] for job in (*jobs[:3], replace(jobs[0], device="auto"))]
    assert declared == {"MEMORY": 100, "GPU": 2, "DISK": 1}
    assert wanted == [{"MEMORY": 30}, {"MEMORY": 100}, {}, {"MEMORY": 30, "GPU": 1}]


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_does_what_this_machine_does(jobs, tmp_path):
    pytest.importorskip("distributed")
    killed: list[int] = []

    def kill(event: Event) -> None:
        if event.kind == "done" and not killed:
            killed.append(worker_processes()[0])
            os.kill(killed[0], signal.SIGKILL)

    cluster = EngineSettings(kind="dask", cluster=ClusterSettings(kind="local", jobs=2))
    assert run(jobs, tmp_path / "out", cluster, report=kill).done == 4
    assert len(killed) == 1
    known = [results(job) for job in jobs]
    run(jobs[:1], tmp_path / "out", EngineSettings(workers=1, threads=1), resume=False)
    assert known == [results(jobs[0])] * 4


@pytest.mark.slow
def test_a_queue_runs_the_pairs(jobs, tmp_path, monkeypatch):
    """With a queue of two commands that start and stop jobs at once, as Slurm's would some time later."""
    pytest.importorskip("dask_jobqueue")
    commands = {
        "sbatch": 'cp "$1" "$1.copy"; bash "$1.copy" >/dev/null 2>&1 & echo "Submitted batch job $!"',
        "scancel": 'pkill -P "$1"; kill "$1"',
    }
    for name, line in commands.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{line}\n", encoding="ascii")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    cluster = ClusterSettings(kind="slurm", jobs=1, workers=2, cores=2, memory=4_000_000_000)
    summary = run(jobs, tmp_path / "out", EngineSettings(kind="dask", cluster=cluster))
    assert summary.done == 4
