"""Runs the benchmarks that are named on the command line, or all of them."""

import sys

from . import (
    analysis,
    cells,
    clocks,
    cluster,
    cost,
    crashes,
    endurance,
    environments,
    fused,
    hand,
    lanes,
    links,
    live,
    machine,
    million,
    own_laws,
    page,
    presets,
    reading,
    replay,
    ros2,
    stalls,
    stop,
    tick,
    tls,
    verify,
    virtual,
    writer,
)

BENCHMARKS = {
    "tick": tick.run,
    "links": links.run,
    "virtual": virtual.run,
    "fused": fused.run,
    "writer": writer.run,
}
LONG = {
    "analysis": analysis.run,
    "cells": cells.run,
    "clocks": clocks.run,
    "cluster": cluster.run,
    "cost": cost.run,
    "crashes": crashes.run,
    "environments": environments.run,
    "hand": hand.run,
    "lanes": lanes.run,
    "million": million.run,
    "own_laws": own_laws.run,
    "presets": presets.run,
    "reading": reading.run,
    "replay": replay.run,
    "ros2": ros2.run,
    "stalls": stalls.run,
    "stop": stop.run,
    "tls": tls.run,
    "verify": verify.run,
    "endurance": endurance.run,
    "live": live.run,
    "page": page.run,
}
"""Benchmarks that run only if they are named."""


def main() -> None:
    chosen = sys.argv[1:] or list(BENCHMARKS)
    known = {**BENCHMARKS, **LONG}
    unknown = [name for name in chosen if name not in known]
    if unknown:
        sys.exit(f"no benchmark {', '.join(unknown)}; there are {', '.join(known)}")
    print(machine.describe())
    for name in chosen:
        print("\n".join(known[name]()))


main()
