"""Connects to a Dask cluster, whose workers run the items of a study.

Dask distributes work over several machines: a scheduler assigns items, such as simulated runs,
to worker processes. Results are comparable only if all workers compute in exactly the same way.
Workers are therefore checked before any item is sent. Each worker also checks itself before
every batch of items, so that workers that join later meet the same requirements.

User-written control laws are not sent to the workers, because the hash of a law covers only one
file, which may import others. The worker must already have the file.

Invariant:
    - An item runs only on a worker with the same program, the same arithmetic and the same
      versions of the computing packages.
"""

import hashlib
import platform
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from functools import cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from ..core import compute_fingerprint
from ..errors import RunFailed, ScenarioError, UsageError
from ..files import Extra
from ..log import collect_provenance
from ..net import SystemClock, check_hosts
from ..own_code import read_code
from ..package_names import PACKAGE_COMMANDS

CONNECT_S = 10.0
"""Longest time to wait for a scheduler to reply, and for its first worker, in s."""
NO_WORKER_S = 60.0
"""Longest time for which a cluster may be without a worker, in s."""
_PACKAGES = ("numpy", "numba", "scipy")
"""Packages whose versions influence the results."""


def _import_distributed() -> Any:
    """Imports `distributed`, the Dask package that runs work on a cluster of machines.

    Raises:
        UsageError: The package is not installed.
    """
    return Extra("cluster", "clusters").import_module("distributed")


WorkerIdentity = Mapping[str, str]
"""Properties of a worker as texts: the versions of the program, its sources, commit,
arithmetic, Python and packages.
"""


@cache
def describe_worker() -> WorkerIdentity:
    """Returns everything about this process that its numerical results depend on.

    A worker of a cluster may run items of a study only if its description equals that of the
    process that started the study, apart from the commit. Otherwise, the results could differ.
    """
    digest = hashlib.sha256()
    for root in _find_sources():
        for file in sorted(root.rglob("*.py")):
            name = file.relative_to(root.parent).as_posix()
            digest.update(name.encode() + b"\0" + file.read_bytes())

    provenance = collect_provenance()
    return {
        "trilat-net": provenance["version_trilat-net"],
        "source files": digest.hexdigest()[:16],
        "commit": provenance["commit"][:12],
        "arithmetic": compute_fingerprint(),
        "Python": ".".join(platform.python_version_tuple()[:2]),
        **{name: metadata.version(name) for name in _PACKAGES},
    }


def _find_sources() -> list[Path]:
    """Returns the folders of this program's sources, with those of its installed packages."""
    specs = [find_spec(name.replace("-", "_")) for name in sorted(PACKAGE_COMMANDS)]
    origins = [Path(spec.origin) for spec in specs if spec is not None and spec.origin]
    program = Path(__file__).resolve().parents[1]
    return [program, *(origin.resolve().parent for origin in origins)]


class WorkerRequirements(NamedTuple):
    """Conditions that a cluster worker must meet to compute the same results as this machine.

    They cover the program version, the floating-point arithmetic, and the files of user-written
    control laws.

    Attributes:
        identity: Properties that the worker must have.
        laws: Pairs of the name of an imported control law, such as "mylaws:Spring", and the
            SHA-256 of its file. The worker must have these files.
    """

    identity: WorkerIdentity
    laws: tuple[tuple[str, str], ...] = ()

    def explain_unfit_worker(self, identity: WorkerIdentity, lacks: Sequence[str]) -> str:
        """Explains why a worker of a cluster may not run items of a study.

        A worker must have the same source files, package versions, floating-point results and
        control-law files as the process that started the study. Its Git commit may differ,
        since commits can differ in documentation only. If the source files differ, the
        explanation also names the commits, as a hint.

        Args:
            identity: Versions and other properties of the worker.
            lacks: Imported control laws whose file the worker does not have.

        Returns:
            The rest of a sentence that begins with "the worker". Empty if the worker may run
            items.
        """
        local = self.identity
        differing = [
            name for name in local if name != "commit" and identity.get(name) != local[name]
        ]
        if differing:
            if "source files" in differing:
                differing.append("commit")
            remote_text = _list_properties(identity, differing)
            local_text = _list_properties(local, differing)
            return (
                f"has {remote_text}, but the study needs {local_text}; "
                "results from both cannot be mixed"
            )

        if lacks:
            return (
                f"lacks the control law {', '.join(lacks)}, or has another file of it: "
                "put the file that the scenario names into the worker's folder or PYTHONPATH"
            )
        return ""

    def check_this_worker(self) -> None:
        """Raises UsageError if this worker could compute different results.

        A worker that joins during the study must check itself, because the results of different
        program versions must not be mixed.

        Raises:
            UsageError: This worker does not meet the requirements. The message names the worker
                and the differences.
        """
        reason = self.explain_unfit_worker(describe_worker(), self.find_missing_laws(self.laws))
        if reason:
            worker = _import_distributed().get_worker()
            raise UsageError(f"the worker {worker.address} {reason}")

    @staticmethod
    def find_missing_laws(laws: Sequence[tuple[str, str]]) -> list[str]:
        """Returns the user's control laws whose file is missing or different on this worker.

        A worker without the right file could not run the study, or would compute different
        results.

        Args:
            laws: Pairs of law name and SHA-256 of the law's file.
        """
        missing = []
        for code, sha256 in laws:
            try:
                local_sha256 = read_code(code, "control.law").sha256
            except ScenarioError:
                local_sha256 = ""
            if local_sha256 != sha256:
                missing.append(code)
        return missing


def _list_properties(identity: WorkerIdentity, names: Sequence[str]) -> str:
    """Formats some properties of a worker as text for an error message."""
    return ", ".join(f"{name} {identity.get(name, 'unknown')}" for name in names)


def _make_probe() -> Callable[
    [Sequence[tuple[str, str]]], tuple[WorkerIdentity, Sequence[str]]
]:
    """Returns a function that describes the process in which it is called.

    A worker may have another version of this program, or lack the program. Dask sends the code
    of a nested function itself, and not only its name, so that the function runs on such a
    worker too.
    """

    def probe(laws: Sequence[tuple[str, str]]) -> tuple[WorkerIdentity, Sequence[str]]:
        """Describes the current worker process, and checks its files of control laws.

        Args:
            laws: Pairs of the name of an imported control law and the SHA-256 of its file.

        Returns:
            The versions on which this process's results depend, and the names of the laws whose
            file is missing on this worker or has different contents.
        """
        try:
            from trilat_net.work import dask_cluster
        except ImportError:
            return {"trilat-net": "of another version, or none"}, ()
        missing_laws = dask_cluster.WorkerRequirements.find_missing_laws(laws)
        return dask_cluster.describe_worker(), missing_laws

    return probe


class DaskCluster:
    """Connection to the scheduler of a Dask cluster, whose workers run the items of a study.

    Used as a context manager, which closes the connection on exit and cancels all unfinished
    items.

    Args:
        address: Address of the scheduler, such as "tcp://HOST:PORT".

    Raises:
        UsageError: Dask is not installed, or no scheduler replies at the address.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self._clock = SystemClock()
        self._last_worker_ns = -1
        try:
            check_hosts([address])
        except UsageError as unknown_host:
            raise UsageError(f"--on {unknown_host}") from None
        try:
            self._client = _import_distributed().Client(
                address, timeout=CONNECT_S, set_as_default=False
            )
        except (OSError, ValueError, TypeError) as error:  # TimeoutError is an OSError
            reason = str(error).splitlines()[0]
            raise UsageError(
                f"--on {address}: no Dask scheduler responds at this address: {reason}"
            ) from None

    def __enter__(self) -> "DaskCluster":
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    @property
    def executor(self) -> Executor:
        """A `concurrent.futures.Executor` that runs functions on the cluster's workers.

        Every call is executed, even if an earlier call had the same arguments.
        """
        executor: Executor = self._client.get_executor(pure=False)
        return executor

    @property
    def workers(self) -> int:
        """Number of items that the cluster can run at the same time, one per thread.

        The number may change as workers join and leave.
        """
        workers = self._client.scheduler_info()["workers"]
        return sum(worker["nthreads"] for worker in workers.values())

    def require(self, laws: Sequence[tuple[str, str]]) -> WorkerRequirements:
        """Determines the requirements of a study, and checks all workers of the cluster.

        A worker must run the same program version and package versions as this process, use the
        same floating-point arithmetic, and have the files of all imported control laws.
        Otherwise, results would differ.

        Args:
            laws: Pairs of the name of an imported class that the items of the study need and
                the SHA-256 of its file.

        Returns:
            The requirements, against which workers that join later check themselves.

        Raises:
            UsageError: No worker appeared within `CONNECT_S`, or a worker does not meet the
                requirements.
        """
        try:
            self._client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError:
            raise UsageError(
                f"--on {self.address}: the scheduler has no worker; "
                f"start some with: dask worker {self.address}"
            ) from None

        required = WorkerRequirements(describe_worker(), tuple(laws))
        # Dask itself reports the versions of Python. They are checked first, because code
        # cannot be sent between different versions.
        python = required.identity["Python"]
        for worker, versions in self._client.get_versions()["workers"].items():
            worker_python = ".".join(str(versions["host"]["python"]).split(".")[:2])
            if worker_python != python:
                raise UsageError(
                    f"the worker {worker} has Python {worker_python}, "
                    f"but this program runs on Python {python}"
                )

        answers = self._client.run(_make_probe(), required.laws, on_error="return")
        for worker, answer in answers.items():
            if isinstance(answer, BaseException):
                raise UsageError(f"the worker {worker} does not report its version: {answer}")
            identity, missing_laws = answer
            reason = required.explain_unfit_worker(identity, missing_laws)
            if reason:
                raise UsageError(f"the worker {worker} {reason}")
        return required

    def check_alive(self) -> None:
        """Raises RunFailed if the cluster no longer has any workers.

        A study calls this regularly while waiting for results, because it could otherwise wait
        forever.

        Raises:
            RunFailed: The scheduler no longer responds, or had no worker for `NO_WORKER_S`.
        """
        try:
            workers = self.workers
        except (OSError, TimeoutError) as error:
            raise RunFailed(
                f"the scheduler at {self.address} no longer responds: {error}"
            ) from None

        now_ns = self._clock.monotonic_ns()
        if workers or self._last_worker_ns < 0:
            self._last_worker_ns = now_ns
        elif now_ns - self._last_worker_ns > NO_WORKER_S * 1e9:
            raise RunFailed(
                f"the cluster at {self.address} has had no worker for {NO_WORKER_S:g} s"
            )

    def is_worker_loss(self, error: BaseException) -> bool:
        """Distinguishes the death of a worker process from an error in its item.

        If a worker has died, its items can be retried on another worker. If an item has failed,
        for example because of unmet requirements, retrying would be pointless.

        Args:
            error: The exception with which an item ended.

        Returns:
            True if the workers that ran the item died.

        Raises:
            RunFailed: The scheduler no longer responds, or a worker cannot receive items.
        """
        if isinstance(error, _import_distributed().KilledWorker):
            return True
        if isinstance(error, UsageError):
            return False
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise RunFailed(f"the cluster at {self.address} cannot continue: {reason}") from None
