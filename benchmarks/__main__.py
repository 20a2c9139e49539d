"""Runs the benchmarks that are named, or all."""

import sys

from . import machine, tick, virtual

BENCHMARKS = {"tick": tick.run, "virtual": virtual.run}


def main() -> None:
    chosen = sys.argv[1:] or list(BENCHMARKS)
    unknown = [name for name in chosen if name not in BENCHMARKS]
    if unknown:
        sys.exit(f"no benchmark {', '.join(unknown)}; there are {', '.join(BENCHMARKS)}")
    print(machine.describe())
    for name in chosen:
        print("\n".join(BENCHMARKS[name]()))


main()
