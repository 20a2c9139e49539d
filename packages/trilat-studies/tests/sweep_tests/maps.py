"""Results of sweeps that were never run, for tests of drawings."""

from collections.abc import Callable, Iterator
from itertools import product
from typing import Any

from trilat_studies.sweep.stability_map import MapPlane, build_plane
from trilat_studies.sweep.sweep_cell import CellClass

from trilat_net.scenario import load_scenario

P_D = load_scenario("p_d_margin")
DELAYS_MS = (0, 100, 200, 300, 400)
DAMPINGS = (0.2, 0.7, 1.2, 1.7, 2.2)
KEYS = ("link.delay_ms", "control.d")

Row = dict[str, Any]
Judge = Callable[..., CellClass]


def judge_by_condition(delay_ms: float, d: float, *_: Any) -> CellClass:
    """Returns the verdict of P+d's condition for K = 10 and three sites."""
    return CellClass.CONVERGED if d > 5e-3 * delay_ms else CellClass.BOUNDED


def rows(verdict: Judge = judge_by_condition, seeds: int = 1, **axes: Any) -> Iterator[Row]:
    """Yields one row per place and seed, judged by a function of its values and its seed."""
    values_by_key = {KEYS[0]: DELAYS_MS, KEYS[1]: DAMPINGS} | {
        key.replace("__", "."): axis_values for key, axis_values in axes.items()
    }
    for number, values in enumerate(product(*values_by_key.values())):
        for seed in range(1, seeds + 1):
            yield {
                "cell": number,
                **dict(zip(values_by_key, values, strict=True)),
                "law": "p_d",
                "seed": seed,
                "verdict": verdict(*values, seed).value,
                "ran_s": 20.0,
                "diverged_s": None,
                "scenario": P_D.text,
            }


def make_plane(verdict: Judge = judge_by_condition, seeds: int = 1, **axes: Any) -> MapPlane:
    """Returns the plane of these rows."""
    rows_of_map = list(rows(verdict, seeds, **axes))
    return build_plane(rows_of_map, [*KEYS, *(key.replace("__", ".") for key in axes)], P_D)
