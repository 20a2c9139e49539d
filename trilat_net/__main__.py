"""Entry point of `trilat` and `python -m trilat_net`; who stops arms does not wait for other
commands.

Invariant: what is printed into a file or pipe is UTF-8 with the line ends of POSIX on every
system, like any text that is written; a terminal that lacks a letter shows its number.
"""

import atexit
import gc
import io
import os
import sys
from contextlib import suppress


def main() -> None:
    """Runs `trilat`."""
    # with Python's own thresholds a ninth of the start is spent there
    gc.set_threshold(100_000, 20, 20)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            if not stream.isatty():
                stream.reconfigure(encoding="utf-8", newline="\n")
            stream.reconfigure(errors="backslashreplace")
    code: int | None = None
    atexit.register(lambda: _leave(code))  # first, so that it is called last
    try:
        _run()
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
        raise


def _run() -> None:
    if sys.argv[1:2] == ["stop"]:
        if sys.platform == "linux":
            with suppress(OSError):  # before the other programs of a busy machine, if it may
                os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
        from .net.known_sites import stop_at_once

        left = stop_at_once(sys.argv[2:])
        if isinstance(left, int):
            sys.exit(left)
        sys.argv[2:] = left
    from .cli import main as run

    match sys.argv[1:]:
        case ["start-processes", number, scenario_file] if number.isdecimal():
            from recorder import record_process  # noqa: F401 - loaded once, not in each process that is started
            from sites import site_process  # noqa: F401
            from sites.demo_session import run_starter

            if (words := run_starter(int(number), scenario_file)) is None:
                return
            sys.argv[1:] = words
    run()


def _leave(code: int | None) -> None:
    # whose threads abort a process without Python
    if code is not None and "zenoh" in sys.modules:
        with suppress(OSError):  # which Python says itself
            sys.stdout.flush()
            os._exit(code & 0xFF)


if __name__ == "__main__":
    main()
