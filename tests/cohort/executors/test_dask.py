"""Clusters: queues get what is written, and a lost worker costs nothing but time."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
from cohort_files import results

from torchdeform.cohort.run import Event, run
from torchdeform.cohort.settings import ClusterSettings, EngineSettings
from torchdeform.core.worker import EngineError

# Away from every network dask has no address to look up, and takes the name of the machine.
pytestmark = pytest.mark.filterwarnings("ignore:Couldn't detect a suitable IP address")


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


def test_a_scheduler_that_is_not_there_is_named(jobs, tmp_path, monkeypatch):
    dask = pytest.importorskip("torchdeform.cohort.executors.dask")
    pytest.importorskip("distributed")
    monkeypatch.setattr(dask, "_CONNECT", "0.5s")
    monkeypatch.setattr(dask, "measure", lambda jobs: [0] * len(jobs))
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
