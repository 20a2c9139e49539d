"""Feeds the readers of logs with what a fuzzer makes up; run by hand, never by the test suite.

    pip install atheris                       # into an environment of its own; it is in no lock
    python tests/fuzz_log.py -max_total_time=300

The fuzzer's bytes are choices (`tests/log/hostility.py`): what to change in a log, and how. With
`--bytes` they are the file itself. Anything but a `TrilatError` is a finding, and so is a process that takes
more than 512 MiB; the choices that led there are kept in a file `crash-*`, to be given as an argument.
"""

import struct
import sys
import tempfile
from pathlib import Path

import atheris  # type: ignore[import-not-found]

from tests.log.builders import edit_log_bytes, make_log_bytes
from tests.log.hostility import mangle_log

sys.path.insert(0, str(Path(__file__).parents[1]))

# what Numba compiles cannot be instrumented
import trilat_net.core.step.site_step  # noqa: F401

with atheris.instrument_imports(
    include=["trilat_net.log", "trilat_net.execution", "trilat_net.app.play", "mcap"]
):
    from tests.log.hostility import read_by_all

SHORT = {"duration_s": 0.04, "link.delay_ms": 5.0}
LOGS = (
    edit_log_bytes(make_log_bytes("paper", SHORT), chunk_bytes=4096),
    make_log_bytes("jitter", {"duration_s": 0.04}),
)
MEMORY_MB = 512


class Choices:
    """Choices that a fuzzer's bytes make."""

    def __init__(self, data: bytes) -> None:
        self._data = atheris.FuzzedDataProvider(data)

    def randrange(self, start: int, stop: int) -> int:
        """Returns a number from start to before stop."""
        return int(self._data.ConsumeIntInRange(start, stop - 1))

    def random(self) -> float:
        """Returns a number from 0 to before 1."""
        return self.randrange(0, 1 << 20) / (1 << 20)


def fuzz_changed_log(data: bytes) -> None:
    """Runs once: a log, changed by the fuzzer's bytes, is read by all readers."""
    choices = Choices(data)
    log = LOGS[choices.randrange(0, len(LOGS))]
    fuzz_bytes(mangle_log(log, choices))


def fuzz_bytes(data: bytes) -> None:
    """Runs once: the bytes are read by all readers."""
    PATH.write_bytes(data)
    read_by_all(PATH)


def main() -> None:
    """Runs until the fuzzer is stopped, or until a finding."""
    as_bytes = "--bytes" in sys.argv
    arguments = [argument for argument in sys.argv if argument != "--bytes"]
    if as_bytes:
        (FOLDER / "seeds").mkdir()
        for n, log in enumerate(LOGS):
            (FOLDER / "seeds" / str(n)).write_bytes(log)
        (FOLDER / "seeds" / "magic").write_bytes(
            b"\x89MCAP0\r\n" + struct.pack("<BQ", 1, 8) + bytes(8)
        )
        arguments.append(str(FOLDER / "seeds"))
    limits = [f"-rss_limit_mb={MEMORY_MB}", "-timeout=120"]
    long = [] if as_bytes else ["-len_control=0", "-max_len=300"]
    atheris.Setup([*arguments, *limits, *long], fuzz_bytes if as_bytes else fuzz_changed_log)
    atheris.Fuzz()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        FOLDER = Path(name)
        PATH = FOLDER / "file.mcap"
        main()
