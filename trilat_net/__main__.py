"""Runs the command `trilat`, also as `python -m trilat_net`.

`trilat stop` is executed before the modules of the other commands are loaded, so arms stop
without delay.

Invariant:
    - Output to a file or pipe is UTF-8 with POSIX line endings on every system, like all files
      written by the program.
    - A character that a terminal cannot display is replaced by its code.
"""

import atexit
import gc
import io
import os
import sys
from contextlib import suppress


def main() -> None:
    """Runs the command given on the command line (entry point of `trilat`).

    The command `trilat stop` is executed before the rest of the program is loaded, so arms stop
    without delay.
    """
    # With Python's default thresholds, garbage collection takes a ninth of the start-up time.
    gc.set_threshold(100_000, 20, 20)

    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # Files and pipes get the same text on every system.
            if not stream.isatty():
                stream.reconfigure(encoding="utf-8", newline="\n")
            stream.reconfigure(errors="backslashreplace")

    code: int | None = None
    # The function that is registered first is called last.
    atexit.register(lambda: _exit_before_zenoh(code))
    try:
        _run()
    except SystemExit as exit_request:
        code = int(exit_request.code is not None)
        if isinstance(exit_request.code, int):
            code = exit_request.code
        raise


def _run() -> None:
    """Runs the command given on the command line.

    Two commands are handled before the others are loaded: `stop`, to stop arms without delay,
    and the hidden command `start-processes`, which forks the processes of a session.
    """
    if sys.argv[1:2] == ["stop"]:
        if sys.platform == "linux":
            # Run ahead of other programs on a busy machine, if this is permitted.
            with suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
        from .net import stop_at_once

        # The result is an exit code, or arguments that the full command has to handle.
        code_or_arguments = stop_at_once(sys.argv[2:])
        if isinstance(code_or_arguments, int):
            sys.exit(code_or_arguments)
        sys.argv[2:] = code_or_arguments

    from .app.cli import main as run

    match sys.argv[1:]:
        case ["start-processes", number, scenario_file] if number.isdecimal():
            # Loaded once here, these modules need not be loaded in each forked process.
            from recorder import record_session  # noqa: F401
            from sites import run_site  # noqa: F401
            from trilat_net.app import recorded_session  # noqa: F401
            from trilat_net.app.demo_session import run_starter

            arguments = run_starter(int(number), scenario_file)
            if arguments is None:
                return
            sys.argv[1:] = arguments
    run()


def _exit_before_zenoh(code: int | None) -> None:
    """Ends the process immediately if the network library Zenoh is loaded.

    Otherwise, Python would shut down before Zenoh's threads, which would then abort the
    process.

    Args:
        code: The exit code. None if the process ends with an exception, which Python then
            reports.
    """
    if code is not None and "zenoh" in sys.modules:
        with suppress(OSError):  # Python reports this error itself
            sys.stdout.flush()
            os._exit(code & 0xFF)


if __name__ == "__main__":
    main()
