"""A Dask cluster that runs the items of a study.

Invariant: an item runs only on a worker with the same program, the same arithmetic and the same
versions of what computes. Workers are asked before anything is sent, and each checks itself
before every batch, so one that joins later is held to the same. A user's control law is not
sent along: its hash covers one file, and that file may import others; the worker must have it.
"""

import hashlib
import platform
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from ..core.fingerprint import compute_fingerprint
from ..errors import RunFailed, ScenarioError, UsageError
from ..files import import_extra
from ..log.log_layout import collect_provenance
from ..net.clock import SystemClock
from ..net.host_names import UnknownHost, check_hosts
from ..scenario.code_consent import ImportedCode
from ..scenario.imported_code import read_code

CONNECT_S = 10.0
"""A scheduler that does not answer within this time, or has no worker by then, is given up."""
NO_WORKER_S = 60.0
"""A cluster that has lost its last worker may take this long to find another."""
_PACKAGES = ("numpy", "numba", "scipy")


def _distributed() -> Any:
    return import_extra("distributed", "cluster", "clusters")


WorkerIdentity = Mapping[str, str]
"""Per name of a property its text: program, sources, commit, arithmetic, Python, packages."""


@cache
def describe_worker() -> WorkerIdentity:
    """Returns all of this process that results depend on, besides the items."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    provenance = collect_provenance()
    return {
        "trilat-net": provenance["version_trilat-net"],
        "source files": digest.hexdigest()[:16],
        "commit": provenance["commit"][:12],
        "arithmetic": compute_fingerprint(),
        "Python": ".".join(platform.python_version_tuple()[:2]),
        **{name: metadata.version(name) for name in _PACKAGES},
    }


class WorkerRequirements(NamedTuple):
    """What a worker must have: an identity, and the files of laws by (code, sha256)."""

    identity: WorkerIdentity
    laws: tuple[tuple[str, str], ...] = ()


def find_unfit_workers(
    required: WorkerRequirements, identity: WorkerIdentity, lacks: Sequence[str]
) -> str:
    """Returns why a worker is refused, or ""."""
    here = required.identity
    named = [name for name in here if name != "commit" and identity.get(name) != here[name]]
    if named:
        named += ["commit"] if "source files" in named else []
        there, own = (
            ", ".join(f"{name} {one.get(name, 'unknown')}" for name in named)
            for one in (identity, here)
        )
        return f"has {there}, and here is {own}; results are not mixed"
    remedy = "put the file that the scenario names into the worker's folder or PYTHONPATH"
    return (
        f"lacks the control law {', '.join(lacks)}, or has another file of it: {remedy}"
        if lacks
        else ""
    )


def find_missing_laws(laws: Sequence[tuple[str, str]]) -> list[str]:
    """Returns the laws whose file this process has not, or not with that hash."""
    missing = []
    for code, sha256 in laws:
        try:
            found = read_code(code, "control.law").sha256
        except ScenarioError:
            found = ""
        if found != sha256:
            missing.append(code)
    return missing


def check_this_worker(required: WorkerRequirements) -> None:
    """Refuses to work in a process that is not as required.

    Raises:
        UsageError: it is not; names the worker and both sides.
    """
    why = find_unfit_workers(required, describe_worker(), find_missing_laws(required.laws))
    if why:
        raise UsageError(f"the worker {_distributed().get_worker().address} {why}")


def _make_probe() -> Callable[
    [Sequence[tuple[str, str]]], tuple[WorkerIdentity, Sequence[str]]
]:

    def probe(laws: Sequence[tuple[str, str]]) -> tuple[WorkerIdentity, Sequence[str]]:
        try:
            from trilat_net.studies import dask_cluster
        except ImportError:
            return {"trilat-net": "of another version, or none"}, ()
        return dask_cluster.describe_worker(), dask_cluster.find_missing_laws(laws)

    return probe


class DaskCluster:
    """A connection to a Dask scheduler; a context, which closes it and cancels what is under
    way.

    Raises:
        UsageError: Dask is not installed, the scheduler does not answer, or it has no worker.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self._clock = SystemClock()
        self._alone_ns = -1
        try:
            check_hosts([address])
            self._client = _distributed().Client(
                address, timeout=CONNECT_S, set_as_default=False
            )
        except UnknownHost as unknown:
            raise UsageError(f"--on {unknown}") from None
        except (OSError, ValueError, TypeError) as error:  # TimeoutError is an OSError
            raise UsageError(
                f"--on {address}: no Dask scheduler answers there: {str(error).splitlines()[0]}"
            ) from None

    def __enter__(self) -> "DaskCluster":
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    @property
    def executor(self) -> Executor:
        """Runs a function on some worker."""
        executor: Executor = self._client.get_executor(pure=False)
        return executor

    @property
    def workers(self) -> int:
        """How many items its workers run at the same time."""
        return sum(
            worker["nthreads"] for worker in self._client.scheduler_info()["workers"].values()
        )

    def require(self, laws: Sequence[ImportedCode]) -> WorkerRequirements:
        """Returns what every worker must have, and checks those that are there.

        Raises:
            UsageError: there is none within some seconds, or one has it not.
        """
        try:
            self._client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError:
            raise UsageError(
                f"--on {self.address}: the scheduler has no worker; start some with: dask worker "
                f"{self.address}"
            ) from None
        files = tuple(dict.fromkeys((law.code, law.source_sha256) for law in laws))
        required = WorkerRequirements(describe_worker(), files)
        python = required.identity["Python"]
        versions = self._client.get_versions()["workers"]
        for (
            worker,
            found,
        ) in versions.items():  # by Dask itself: code crosses no two versions of Python
            there = ".".join(str(found["host"]["python"]).split(".")[:2])
            if there != python:
                raise UsageError(
                    f"the worker {worker} has Python {there}, and here is Python {python}"
                )
        for worker, answer in self._client.run(_make_probe(), files, on_error="return").items():
            if isinstance(answer, BaseException):
                raise UsageError(
                    f"the worker {worker} cannot be asked for its version: {answer}"
                )
            if why := find_unfit_workers(required, *answer):
                raise UsageError(f"the worker {worker} {why}")
        return required

    def check_alive(self) -> None:
        """Gives up a cluster that is gone, or has been without a worker for `NO_WORKER_S`.

        Raises:
            RunFailed: it is.
        """
        try:
            workers = self.workers
        except (OSError, TimeoutError) as error:
            raise RunFailed(f"the scheduler at {self.address} is gone: {error}") from None
        now_ns = self._clock.monotonic_ns()
        if workers or self._alone_ns < 0:
            self._alone_ns = now_ns
        elif now_ns - self._alone_ns > NO_WORKER_S * 1e9:
            raise RunFailed(
                f"the cluster at {self.address} has had no worker for {NO_WORKER_S:g} s"
            )

    def is_worker_loss(self, error: BaseException) -> bool:
        """Returns whether an item's workers died.

        Raises:
            RunFailed: the scheduler is gone, or a worker cannot take items.
        """
        if isinstance(error, _distributed().KilledWorker):
            return True
        if isinstance(error, UsageError):
            return False
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise RunFailed(f"the cluster at {self.address} cannot go on: {reason}") from None
