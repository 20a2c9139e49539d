"""Compares verifying a log by compiled code with reading and executing its records one by one.

Both methods are measured alternately in one process. The result is the ratio of their processor
times.
"""

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

from trilat_net.execution import verification, virtual
from trilat_net.log import mcap_reader
from trilat_net.log.log_reader import open_log
from trilat_net.log.packed.indexed_records import IndexedRecords
from trilat_net.scenario import load_scenario

CASES = ("paper", "4g", "six_joints")
SECONDS = 20.0
ROUNDS = 5


def run() -> list[str]:
    lines = [f"verify {SECONDS:g} s of three sites at 1 kHz, from the file, on one core:"]
    with tempfile.TemporaryDirectory() as folder:
        for name in CASES:
            path = Path(folder) / f"{name}.mcap"
            with path.open("wb") as stream:
                virtual.write_virtual_log(load_scenario(name, {"duration_s": SECONDS}), stream)
            lines.append(_compare(name, path))
    return lines


def _compare(name: str, path: Path) -> str:
    """Measures both methods alternately for one log."""
    records = verification.verify_log(open_log(path)).identical  # compiles
    pairs = []
    for _ in range(ROUNDS):
        fast_s = min(
            _processor_s(lambda: verification.verify_log(open_log(path))) for _ in range(3)
        )
        pairs.append((fast_s, _processor_s(lambda: verify_singly(path))))
    ratio = statistics.median(single_s / fast_s for fast_s, single_s in pairs)
    fast_s, single_s = (min(times) for times in zip(*pairs, strict=True))
    return (
        f"  {name}: {1e3 * fast_s:.0f} ms, {1e9 * fast_s / records:.0f} ns a record, "
        f"{SECONDS / fast_s:.0f} times real time; one by one {single_s:.2f} s; "
        f"{ratio:.1f} times as fast (median of {ROUNDS})"
    )


def verify_singly(path: Path) -> verification.VerifyResult:
    """Verifies a log without compiled reading and without the compiled loop."""
    with (
        mock.patch.object(mcap_reader, "_BLOCK_BYTES", 1 << 40),
        mock.patch.object(IndexedRecords, "of_payloads", return_value=None),
    ):
        return verification.verify_log(open_log(path))


def _processor_s(call: Callable[[], object]) -> float:
    """Returns the processor time of a call, in s."""
    begun = time.process_time()
    call()
    return time.process_time() - begun
