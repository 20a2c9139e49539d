"""Entry point of `trilat` and `python -m trilat_net`; who stops arms does not wait for other commands."""

import sys


def main() -> None:
    """Runs `trilat`."""
    if sys.argv[1:2] == ["stop"]:
        from .net.known_sites import stop_at_once

        left = stop_at_once(sys.argv[2:])
        if isinstance(left, int):
            sys.exit(left)
        sys.argv[2:] = left
    from .cli import main as run

    run()


if __name__ == "__main__":
    main()
