"""A dead-man switch in a terminal: its arm moves while keys are pressed, or while lines come from a program.

    python examples/dead_man_switch.py two_sites s --connect tcp/127.0.0.1:10241
    pedal | python examples/dead_man_switch.py two_sites s --connect tcp/127.0.0.1:10241

A terminal does not say that a key is let go: it repeats one that is held. The switch is let go once nothing
came for --gap-s, which must be longer than a keyboard waits before it repeats; a button could say it sooner.
At the end of its input it is let go at once. Linux and macOS; the scenario has `dead_man = true`.
"""

import argparse
import os
import select
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import trilat_net as tn

PERIOD_S = 0.02


def hold(
    switch: tn.SwitchClient,
    read: Callable[[], bytes | None],
    now_s: Callable[[], float],
    gap_s: float,
) -> None:
    """Holds a switch while something comes in, until its session or its input ends.

    Args:
        switch: of the arm.
        read: waits for a period, and returns what came in; b"" for nothing, None at the end.
        now_s: a clock.
        gap_s: once nothing came for so long, it is let go.
    """
    came_s = -gap_s + now_s()
    try:
        while not switch.over and (keys := read()) is not None:
            if keys:
                came_s = now_s()
            switch.send(held=now_s() - came_s < gap_s)
    finally:
        switch.send(held=False)


def read_input() -> bytes | None:
    """Returns what comes in within a period; None at its end."""
    there, _, _ = select.select([sys.stdin], [], [], PERIOD_S)
    return (os.read(sys.stdin.fileno(), 4096) or None) if there else b""


@contextmanager
def single_keys() -> Iterator[None]:
    """Lets a terminal give every key as it is pressed, and show none; afterwards it is as before."""
    if not sys.stdin.isatty():
        yield
        return
    import termios
    import tty

    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def main() -> None:
    """Holds the switch of a site until its session ends, its input does, or Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", help="its name, as the site prints it")
    parser.add_argument("site", help="whose arm moves while the switch is held")
    parser.add_argument(
        "--connect", action="append", required=True, help="endpoint of the site; repeatable"
    )
    parser.add_argument("--keys", help="folder of the operator's keys, in a session with keys")
    parser.add_argument(
        "--gap-s", type=float, default=0.6, help="let go once nothing came for so long"
    )
    options = parser.parse_args()
    connect = (options.session, options.site, options.connect, options.keys)
    with tn.SwitchClient.connected(*connect) as switch, single_keys():
        hold(switch, read_input, time.monotonic, options.gap_s)


if __name__ == "__main__":
    main()
