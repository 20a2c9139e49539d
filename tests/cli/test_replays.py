"""`trilat replay`: refusals before the session is joined."""

from pathlib import Path

import pytest

from .running import trilat


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        (
            ["--rate", "-1"],
            ["--rate, the speed relative to", "from 0.001 to 1000, or max", "'-1'"],
        ),
        (["--start", "7"], ["--start 7 s: is after the end", "from 0.000 s to 0.499 s"]),
        (["--include", "m1*"], ["--include must be a key expression such as", "'m1*'"]),
        (["--exclude", "**"], ["no message for this selection"]),
        (
            ["--time", "arrival"],
            ["--time must be publish (the time at which", "or log (the", "not 'arrival'"],
        ),
        (["--preload", "-1"], ["--preload must be a number of MiB, at least 0, not -1"]),
        (
            ["--prefix", "a/b"],
            [
                "a session's name must have 1 to 80 characters (letters, digits, _",
                "not 'a/b-paper'",
            ],
        ),
        (["--session", "a b"], ["a session's name must have 1 to 80 characters", "'a b'"]),
        (["--connect", "tcp/127.0.0.1:1", "--router", "tcp/127.0.0.1:2"], ["--router"]),
    ],
)
def test_invalid_requests_are_refused(
    options: list[str], facts: list[str], log_file: Path
) -> None:
    trilat("replay", log_file.name, *options, cwd=log_file.parent).refuses(*facts)
