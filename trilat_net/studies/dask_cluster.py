"""A Dask cluster that runs the items of a study.

Workers are checked before any item is sent. Each worker also checks itself before every batch,
so that a worker that joins later meets the same requirements. A user's control law is not sent
to workers: its hash covers one file, and that file may import others. The worker must have it.

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
"""Longest wait for the answer of a scheduler and for its first worker, s."""
NO_WORKER_S = 60.0
"""Longest time that a cluster may be without a worker, s."""
_PACKAGES = ("numpy", "numba", "scipy")


def _import_distributed() -> Any:
    """Returns the package `distributed`."""
    return import_extra("distributed", "cluster", "clusters")


WorkerIdentity = Mapping[str, str]
"""Text of each property: program, sources, commit, arithmetic, Python, packages."""


@cache
def describe_worker() -> WorkerIdentity:
    """Returns the properties of this process on which results depend."""
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
    """The requirements on a worker.

    Attributes:
        identity: the properties of the worker.
        laws: the code and the SHA-256 of the file of each imported law.
    """

    identity: WorkerIdentity
    laws: tuple[tuple[str, str], ...] = ()


def explain_unfit_worker(
    required: WorkerRequirements, identity: WorkerIdentity, lacks: Sequence[str]
) -> str:
    """Returns the reason why a worker is refused, or "".

    Args:
        required: the requirements.
        identity: the properties of the worker.
        lacks: imported laws whose file the worker lacks.
    """
    local = required.identity
    differing = [
        name for name in local if name != "commit" and identity.get(name) != local[name]
    ]
    if differing:
        if "source files" in differing:
            differing.append("commit")
        remote_text = _list_properties(identity, differing)
        local_text = _list_properties(local, differing)
        return f"has {remote_text}, and here is {local_text}; results are not mixed"
    if lacks:
        return (
            f"lacks the control law {', '.join(lacks)}, or has another file of it: "
            "put the file that the scenario names into the worker's folder or PYTHONPATH"
        )
    return ""


def _list_properties(identity: WorkerIdentity, names: Sequence[str]) -> str:
    """Returns properties of a worker as a text."""
    return ", ".join(f"{name} {identity.get(name, 'unknown')}" for name in names)


def find_missing_laws(laws: Sequence[tuple[str, str]]) -> list[str]:
    """Returns the laws whose file this process lacks, or has with another hash.

    Args:
        laws: the code and the SHA-256 of the file of each law.
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


def check_this_worker(required: WorkerRequirements) -> None:
    """Checks that this process meets the requirements.

    Raises:
        UsageError: it does not; the text names the worker and the differences.
    """
    reason = explain_unfit_worker(required, describe_worker(), find_missing_laws(required.laws))
    if reason:
        worker = _import_distributed().get_worker()
        raise UsageError(f"the worker {worker.address} {reason}")


def _make_probe() -> Callable[
    [Sequence[tuple[str, str]]], tuple[WorkerIdentity, Sequence[str]]
]:
    """Returns a function that describes the process in which it is called.

    It is nested so that Dask sends its code: the worker may lack this module.
    """

    def probe(laws: Sequence[tuple[str, str]]) -> tuple[WorkerIdentity, Sequence[str]]:
        try:
            from trilat_net.studies import dask_cluster
        except ImportError:
            return {"trilat-net": "of another version, or none"}, ()
        return dask_cluster.describe_worker(), dask_cluster.find_missing_laws(laws)

    return probe


class DaskCluster:
    """A connection to a Dask scheduler; a context manager that closes it, with its items.

    Args:
        address: address of the scheduler, as "tcp://HOST:PORT".

    Raises:
        UsageError: Dask is not installed, the scheduler does not answer, or it has no worker.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self._clock = SystemClock()
        self._last_worker_ns = -1
        try:
            check_hosts([address])
            self._client = _import_distributed().Client(
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
        """Executor that runs functions on the workers."""
        executor: Executor = self._client.get_executor(pure=False)
        return executor

    @property
    def workers(self) -> int:
        """Number of items that the workers run at the same time."""
        workers = self._client.scheduler_info()["workers"]
        return sum(worker["nthreads"] for worker in workers.values())

    def require(self, laws: Sequence[ImportedCode]) -> WorkerRequirements:
        """Returns the requirements on every worker, and checks the present workers.

        Args:
            laws: imported laws that the items need.

        Raises:
            UsageError: there is no worker within `CONNECT_S`, or a worker is refused.
        """
        try:
            self._client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError:
            raise UsageError(
                f"--on {self.address}: the scheduler has no worker; "
                f"start some with: dask worker {self.address}"
            ) from None
        files = tuple(dict.fromkeys((law.code, law.source_sha256) for law in laws))
        required = WorkerRequirements(describe_worker(), files)
        # asked of Dask itself first: code cannot be sent between versions of Python
        python = required.identity["Python"]
        for worker, versions in self._client.get_versions()["workers"].items():
            worker_python = ".".join(str(versions["host"]["python"]).split(".")[:2])
            if worker_python != python:
                raise UsageError(
                    f"the worker {worker} has Python {worker_python}, "
                    f"and here is Python {python}"
                )
        answers = self._client.run(_make_probe(), files, on_error="return")
        for worker, answer in answers.items():
            if isinstance(answer, BaseException):
                raise UsageError(f"the worker {worker} does not report its version: {answer}")
            identity, missing_laws = answer
            reason = explain_unfit_worker(required, identity, missing_laws)
            if reason:
                raise UsageError(f"the worker {worker} {reason}")
        return required

    def check_alive(self) -> None:
        """Checks that the cluster still works.

        Raises:
            RunFailed: the scheduler is gone, or has been without a worker for `NO_WORKER_S`.
        """
        try:
            workers = self.workers
        except (OSError, TimeoutError) as error:
            raise RunFailed(f"the scheduler at {self.address} is gone: {error}") from None
        now_ns = self._clock.monotonic_ns()
        if workers or self._last_worker_ns < 0:
            self._last_worker_ns = now_ns
        elif now_ns - self._last_worker_ns > NO_WORKER_S * 1e9:
            raise RunFailed(
                f"the cluster at {self.address} has had no worker for {NO_WORKER_S:g} s"
            )

    def is_worker_loss(self, error: BaseException) -> bool:
        """True if an error says that the workers of an item died.

        Raises:
            RunFailed: the scheduler is gone, or a worker cannot receive items.
        """
        if isinstance(error, _import_distributed().KilledWorker):
            return True
        if isinstance(error, UsageError):
            return False
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise RunFailed(f"the cluster at {self.address} cannot continue: {reason}") from None
