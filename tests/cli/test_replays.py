"""`trilat replay`: what it refuses before it takes part in anything."""

from pathlib import Path

import pytest

from .running import trilat


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        (["--rate", "-1"], ["--rate is how much faster", "from 0.001 to 1000, or max", "'-1'"]),
        (["--rate", "fast"], ["--rate is how much faster", "'fast'"]),
        (["--start", "7"], ["--start 7 s: is beyond the end", "from 0.000 s to 0.499 s"]),
        (["--start", "0.2", "--stop", "0.1"], ["--stop is after --start (0.2 s), not 0.1 s"]),
        (["--stop", "0.1", "--duration", "0.1"], ["--stop and --duration"]),
        (["--duration", "-3"], ["--duration is more than 0 s, not -3"]),
        (["--include", "m1*"], ["--include is a key expression like", "'m1*'"]),
        (["--include", "nobody/**"], ["no message for this selection", "trilat/paper/m1/state"]),
        (["--exclude", "**"], ["no message for this selection"]),
        (["--time", "arrival"], ["--time is publish (as it was sent) or log (as it arrived), not 'arrival'"]),
        (["--preload", "-1"], ["--preload is a number of MiB, not -1"]),
        (["--prefix", "a/b"], ["a session's name is letters, digits, _, - and ., not 'a/b-paper'"]),
        (["--session", "a b"], ["a session's name is letters", "'a b'"]),
        (["--connect", "tcp/127.0.0.1:1", "--router", "tcp/127.0.0.1:2"], ["--router"]),
    ],
)
def test_what_cannot_be_meant_is_refused(options: list[str], facts: list[str], log_file: Path) -> None:
    trilat("replay", log_file.name, *options, cwd=log_file.parent).refuses(*facts)


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    trilat("replay", "run.mcap", cwd=tmp_path).refuses("run.mcap: cannot be read: No such file")
    (tmp_path / "run.mcap").write_bytes(b"")
    trilat("replay", "run.mcap", cwd=tmp_path).refuses("run.mcap")
    (tmp_path / "run.mcap").write_bytes(b"garbage" * 100)
    trilat("replay", "run.mcap", cwd=tmp_path).refuses("run.mcap: is no MCAP file")
