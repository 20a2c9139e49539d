"""Compares a map of 20 x 20 cells under a user's law, compiled and in plain Python, with the built-in law.

All three laws compute P+d. Their cells alternate, and processor times are compared, so that
other work on the machine affects all of them equally.
"""

import time

from trilat_studies.sweep.sweep_cell import classify_cell

from trilat_net.scenario import load_scenario
from trilat_net.workers import count_cores, worker_pool

CELLS = 400
PLAIN = 8
"""Number of cells of the plain law that are run. The time for all cells is extrapolated."""
DURATION_S = 20.0


def _judge(law: str, text: str) -> tuple[str, float, str]:
    """Returns the law, the processor time of its cell, in s, and the verdict."""
    begun = time.process_time()
    verdict = str(classify_cell(text, 0.0).verdict)
    return law, time.process_time() - begun, verdict


def run() -> list[str]:
    laws = {"p_d": CELLS, "tests.own_laws:CompiledPD": CELLS, "tests.own_laws:PD": PLAIN}
    cells = [
        (law, {"control.d": 2.0 + 3.0 * (n % 20) / 20, "link.delay_ms": 20.0 * (n // 20)})
        for n in range(CELLS)
        for law, count in laws.items()
        if n * count // CELLS != (n + 1) * count // CELLS
    ]
    texts = [
        load_scenario("free", {"duration_s": DURATION_S, "control.law": law, **keys}).text
        for law, keys in cells
    ]
    names, cores = [law for law, _ in cells], count_cores()
    with worker_pool(cores) as pool:
        for law in laws:  # begins the processes, and compiles in each of them
            first = texts[names.index(law)]
            list(pool.map(_judge, [law] * 2 * cores, [first] * 2 * cores))
        found = list(pool.map(_judge, names, texts, chunksize=6))
    took = {
        law: sum(s for one, s, _ in found if one == law) / count for law, count in laws.items()
    }
    built_in, compiled, plain = took.values()
    same = [v for law, _, v in found if law == "p_d"] == [
        v for law, _, v in found if law.endswith("CompiledPD")
    ]
    return [
        f"{CELLS} cells of free, {DURATION_S:g} s each, P+d over d and delay, on {cores} cores:",
        f"  built-in {1e3 * built_in:.1f} ms a cell; one's own, compiled, {1e3 * compiled:.1f} ms: "
        f"{built_in / compiled:.2f} of its speed (bar: >= 0.8); verdicts equal: {'yes' if same else 'NO'}",
        f"  one's own in plain Python {plain:.2f} s a cell, by {PLAIN} of them: 20 x 20 cells would take "
        f"{plain * CELLS / 60.0 / 2.0:.1f} min (bar: <= 10 min on 2 cores)",
    ]
