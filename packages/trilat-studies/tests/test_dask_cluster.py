"""Studies on a real Dask cluster on loopback: the same bytes, and no worker that could change them."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from study_builders import SHORT, make_quick_scenario, plan_quick_sweep, run_plan
from trilat_studies.sweep import prepare_sweep_folder, run_sweep
from trilat_studies.sweep.sweep_results import RESULTS_FILE

import trilat_net
from tests.cli.running import trilat
from tests.net.waiting import until
from trilat_net.errors import UsageError
from trilat_net.files import Extra
from trilat_net.work import dask_cluster
from trilat_net.work.dask_cluster import WorkerRequirements, describe_worker
from trilat_net.work.executor import WorkerPool

ROOT = Path(trilat_net.__file__).resolve().parents[1]


class Cluster:
    """A scheduler and its workers, each a process of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.processes: list[subprocess.Popen[bytes]] = []
        file = folder / "scheduler.json"
        self._start("scheduler", "--port", "0", "--no-show", "--scheduler-file", str(file))
        until(lambda: file.exists() and file.read_text(), 60)
        self.address: str = json.loads(file.read_text())["address"]

    def _start(self, *arguments: str, path: Path = ROOT) -> "subprocess.Popen[bytes]":
        """Starts a process of Dask with the program of a folder, and returns the process."""
        log = (self.folder / f"{len(self.processes)}.log").open("wb")
        command = [
            sys.executable,
            "-P",
            "-m",
            "dask",
            *arguments,
            "--host",
            "127.0.0.1",
            "--no-dashboard",
        ]
        process = subprocess.Popen(
            command,
            cwd=self.folder,
            stdout=log,
            stderr=log,
            env={**os.environ, "PYTHONPATH": str(path)},
        )
        log.close()
        self.processes.append(process)
        return process

    def add_worker(self, path: Path = ROOT) -> "subprocess.Popen[bytes]":
        """Starts a worker of one thread without a nanny, so that a killed worker is not restarted."""
        return self._start("worker", self.address, "--nthreads", "1", "--no-nanny", path=path)

    def close(self) -> None:
        """Ends the scheduler and all workers."""
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    started_cluster = Cluster(tmp_path_factory.mktemp("cluster"))
    yield started_cluster
    started_cluster.close()


def assert_losing_a_worker_changes_nothing(cluster: Cluster, folder: Path, count: int) -> None:
    """Asserts that losing one of two workers half way changes no byte of a sweep's results."""
    (folder / "trio.toml").write_text(SHORT.replace("duration_s = 0.5", "duration_s = 4.0"))
    sweep = plan_quick_sweep(
        folder, over=[f"control.Kd=1:{1 + 0.1 * (count - 1):g}:0.1"], longest_s=4.0
    )
    assert sweep.cells == count
    single = run_plan(sweep, folder / "single")

    killed = cluster.add_worker()
    cluster.add_worker()
    done_at_kill: list[int] = []

    def kill_half_way(done: int, total: int) -> None:
        if done >= total // 2 and not done_at_kill:
            os.kill(killed.pid, signal.SIGKILL)
            done_at_kill.append(done)

    until(lambda: count_workers(cluster) == 2, 60)
    shared = run_sweep(
        prepare_sweep_folder(sweep, folder / "shared"),
        progress=kill_half_way,
        on=cluster.address,
    )
    assert killed.wait(10) == -signal.SIGKILL
    assert done_at_kill[0] < count
    assert (shared.runs, shared.jobs) == (count, 2)
    table = (single.folder.path / RESULTS_FILE).read_bytes()
    assert (shared.folder.path / RESULTS_FILE).read_bytes() == table


def count_workers(cluster: Cluster) -> int:
    """Returns how many workers a cluster has."""
    with dask_cluster.DaskCluster(cluster.address) as opened:
        return opened.workers


@pytest.mark.long
@pytest.mark.timeout(120)
def test_losing_a_worker_changes_no_byte(cluster: Cluster, tmp_path: Path) -> None:
    assert_losing_a_worker_changes_nothing(cluster, tmp_path, 300)


@pytest.mark.long
@pytest.mark.timeout(900)  # five minutes for the run without a cluster alone
def test_losing_a_worker_of_2000_cells_changes_nothing(
    cluster: Cluster, tmp_path: Path
) -> None:
    assert_losing_a_worker_changes_nothing(cluster, tmp_path, 2000)


@pytest.mark.long
def test_trials_margins_and_tuning_run_on_a_cluster(cluster: Cluster, tmp_path: Path) -> None:
    """Each study gives the same bytes or outcomes on a cluster and in a process of its own."""
    cluster.add_worker()
    (tmp_path / "trio.toml").write_text(SHORT)
    margin = ("--margin", "control.d=0.2:3", "--set", "control.law=p_d")
    tuning = ("--tune", "trio.toml", "--law", "p_d", "--budget", "4")
    studies = [
        (("sweep", "trio.toml", *margin, "-o"), "margin.json"),
        (("compare", *tuning, "--out"), "front.json"),
    ]
    for command, file in studies:
        local = f"local-{command[0]}"
        shared = f"shared-{command[0]}"
        trilat(*command, local, "--jobs", "1", cwd=tmp_path).succeeds()
        trilat(*command, shared, "--on", cluster.address, cwd=tmp_path).succeeds()
        local_bytes = (tmp_path / local / file).read_bytes()
        assert (tmp_path / shared / file).read_bytes() == local_bytes

    seeds = [5, 2, 9]
    local_report = trilat_net.check(make_quick_scenario(), seeds, jobs=1)
    shared_report = trilat_net.check(make_quick_scenario(), seeds, on=cluster.address)
    assert len(shared_report.results) == len(seeds)
    assert [result.outcomes for result in shared_report.results] == [
        result.outcomes for result in local_report.results
    ]


@pytest.mark.long
def test_workers_with_another_program_are_refused_even_later(
    cluster: Cluster, tmp_path: Path
) -> None:
    """A worker whose source files differ is refused, also if it joins during a study."""
    shutil.copytree(
        ROOT / "trilat_net",
        tmp_path / "trilat_net",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    with (tmp_path / "trilat_net" / "errors.py").open("a") as file:
        file.write("# another one\n")

    first = cluster.add_worker()
    sources = describe_worker()["source files"]
    with WorkerPool.open(None, cluster.address) as pool:
        assert pool.map(abs, [-1, -2]) == [1, 2]
        cluster.add_worker(tmp_path)
        until(lambda: count_workers(cluster) == 2, 60)
        first.kill()
        with pytest.raises(
            UsageError,
            match=rf"the worker tcp://\S+ has source files \w+, .*the study needs.* {sources}",
        ):
            pool.map(abs, range(-99, 0))

    with (
        pytest.raises(UsageError, match=f"source files .* {sources}"),
        WorkerPool.open(None, cluster.address),
    ):
        pass


@pytest.mark.long
def test_a_worker_without_the_laws_file_is_refused(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(ROOT / "tests" / "golden" / "spring_law.py", tmp_path / "lonely_law.py")
    monkeypatch.chdir(tmp_path)
    cluster.add_worker()
    scenario = make_quick_scenario(**{"control.law": "lonely_law:Spring"})
    with pytest.raises(
        UsageError, match=r"the worker tcp://\S+ lacks the control law lonely_law:Spring"
    ):
        trilat_net.check(scenario, on=cluster.address)


def test_differences_are_named_on_both_sides() -> None:
    """A worker with another version or without a law is described; another commit fits."""
    worker = describe_worker()
    requirements = WorkerRequirements(worker)
    assert requirements.explain_unfit_worker(worker, []) == ""
    assert requirements.explain_unfit_worker({**worker, "commit": "other"}, []) == ""
    for name in ("trilat-net", "arithmetic", "Python", "numpy", "numba", "scipy"):
        text = requirements.explain_unfit_worker({**worker, name: "other"}, [])
        assert f"has {name} other, but the study needs {name} {worker[name]}" in text
    assert "a.b:Law" in requirements.explain_unfit_worker(worker, ["a.b:Law"])


@pytest.mark.long
def test_a_scheduler_that_does_not_answer_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dask_cluster, "CONNECT_S", 0.3)
    sweep = ("sweep", "free", "--over", "control.Kd=1,2", "--on")
    trilat(*sweep, "tcp://127.0.0.1:1", cwd=tmp_path).refuses(
        "tcp://127.0.0.1:1", "no Dask scheduler"
    )
    trilat(*sweep, "nowhere", cwd=tmp_path).refuses("nowhere")
    trilat("test", "free", "--on", "tcp://127.0.0.1:1", cwd=tmp_path).refuses(
        "tcp://127.0.0.1:1"
    )
    assert list(tmp_path.iterdir()) == []


def test_without_dask_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=re.escape(Extra("cluster").install_command)):
        dask_cluster.DaskCluster("tcp://127.0.0.1:1")
