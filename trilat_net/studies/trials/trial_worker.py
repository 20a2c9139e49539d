"""A worker process for trials.

One scenario per input line, one JSON reply per output line, until its input ends.

Invariant: it keeps no state between trials, prints only replies, and ends when its parent is gone. It
runs as a command of its own, since `multiprocessing` would run the caller's script again:
`trilat_net.check` works in a script without a guard around its main part.
"""

import sys

import msgspec

from ...errors import TrilatError
from ...net.clock import SystemClock
from ...scenario import parse_scenario
from .measure_run import RunMetrics, measure_virtual_run


class TrialReply(msgspec.Struct):
    """What became of one trial.

    Attributes:
        figures: its figures, or None where it failed.
        wall_s: how long it took.
        error: why it failed.
    """

    figures: RunMetrics | None = None
    wall_s: float = 0.0
    error: str = ""


def serve_trials() -> None:
    """Answers every line of standard input, which is a scenario's canonical text, as JSON."""
    clock = SystemClock()
    for line in sys.stdin.buffer:
        start_ns = clock.monotonic_ns()
        try:
            figures = measure_virtual_run(parse_scenario(msgspec.json.decode(line, type=str)))
            answer = TrialReply(figures, (clock.monotonic_ns() - start_ns) * 1e-9)
        except (TrilatError, ArithmeticError, ValueError, MemoryError) as error:
            answer = TrialReply(error=f"{type(error).__name__}: {error}")
        try:
            sys.stdout.buffer.write(msgspec.json.encode(answer) + b"\n")
            sys.stdout.buffer.flush()
        except BrokenPipeError:
            return


if __name__ == "__main__":
    serve_trials()
