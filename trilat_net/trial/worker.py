"""A process that runs trials for another one: a line in, a line out, until its input ends.

Law: it keeps nothing between two trials, prints nothing but answers, and ends by itself when whoever started
it is gone.

It is started as a command of its own and not through `multiprocessing`, which would run the caller's script
a second time: `trilat_net.check` works in a script without a guard around its main part.
"""

import sys

import msgspec

from ..errors import TrilatError
from ..net.clock import SystemClock
from ..scenario import parse
from .collection import run_virtual
from .figures import Figures


class Answer(msgspec.Struct):
    """What became of one trial.

    Attributes:
        figures: its figures, or None where it failed.
        wall_s: how long it took.
        error: why it failed.
    """

    figures: Figures | None = None
    wall_s: float = 0.0
    error: str = ""


def serve() -> None:
    """Answers every line of standard input, which is a scenario's canonical text, as JSON."""
    clock = SystemClock()
    for line in sys.stdin.buffer:
        start_ns = clock.monotonic_ns()
        try:
            figures = run_virtual(parse(msgspec.json.decode(line, type=str)))
            answer = Answer(figures, (clock.monotonic_ns() - start_ns) * 1e-9)
        except (TrilatError, ArithmeticError, ValueError, MemoryError) as error:
            answer = Answer(error=f"{type(error).__name__}: {error}")
        try:
            sys.stdout.buffer.write(msgspec.json.encode(answer) + b"\n")
            sys.stdout.buffer.flush()
        except BrokenPipeError:
            return


if __name__ == "__main__":
    serve()
