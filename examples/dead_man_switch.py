"""A dead-man switch in a terminal: the arm may move only while a key is held down.

    python examples/dead_man_switch.py two_sites s --connect tcp/127.0.0.1:10241
    pedal | python examples/dead_man_switch.py two_sites s --connect tcp/127.0.0.1:10241

Instead of a key, a program such as `pedal` can write lines while the arm may move. The state of
a ROS robot, which an emergency stop makes false, does so in place of `pedal` with --gap-s 0.1:

    PYTHONUNBUFFERED=1 ros2 topic echo /robot/enabled | grep -i --line-buffered true |
        python examples/dead_man_switch.py two_sites s --connect tcp/127.0.0.1:10241 --gap-s 0.1

A terminal does not report that a key was released, but it repeats a key that is held down. The
switch is therefore released when nothing has arrived for --gap-s. This time must be longer than
the delay after which the keyboard starts to repeat. At the end of the input the switch is
released at once. The scenario of the session needs `dead_man = true`. Works on Linux and macOS.
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
    """Holds a switch while keys arrive, until the session or the input ends.

    Args:
        switch: the dead-man switch of an arm.
        read: waits for one period, and returns the keys that arrived. Empty if there are no
            keys, and `None` at the end of the input.
        now_s: returns the present time, in s.
        gap_s: time without keys after which the switch is released, in s.
    """
    last_key_s = -gap_s + now_s()
    try:
        while not switch.over and (keys := read()) is not None:
            if keys:
                last_key_s = now_s()
            switch.send(held=now_s() - last_key_s < gap_s)
    finally:
        switch.send(held=False)


def read_input() -> bytes | None:
    """Returns the keys that arrive within one period, or `None` at the end of the input."""
    readable, _, _ = select.select([sys.stdin], [], [], PERIOD_S)
    if not readable:
        return b""
    return os.read(sys.stdin.fileno(), 4096) or None


@contextmanager
def single_keys() -> Iterator[None]:
    """Makes the terminal report each key without showing it, until the end of the block."""
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
    """Holds the switch of a site until the session or the input ends, or until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", help="name of the session, as the site prints it")
    parser.add_argument("site", help="site whose arm moves while the switch is held")
    parser.add_argument(
        "--connect", action="append", required=True, help="endpoint of the site; repeatable"
    )
    parser.add_argument("--keys", help="folder of the operator's keys, in a session with keys")
    parser.add_argument(
        "--gap-s",
        type=float,
        default=0.6,
        help="time without keys after which the switch is released, s",
    )
    options = parser.parse_args()
    connect = (options.session, options.site, options.connect, options.keys)
    with tn.SwitchClient.connected(*connect) as switch, single_keys():
        hold(switch, read_input, time.monotonic, options.gap_s)


if __name__ == "__main__":
    main()
