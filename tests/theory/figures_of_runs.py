"""Virtual runs measured by the windows of `[expect]`, and the required closeness of figures.

The figures that tests here cite were made with another implementation of the same equations.
"""

from typing import Any

import pytest
from trilat_studies.measure_run import RunMetrics

from trilat_net.scenario import load_scenario
from trilat_net.scenario.expect import ALL_SITES_QUANTITIES, ExpectWindow

Overrides = dict[str, Any]


def measure_run(
    name: str, overrides: Overrides | None = None, *windows: tuple[float, float, str]
) -> RunMetrics:
    """Returns the metrics of a shipped scenario; windows are (from s, to s, site), with "" for all sites."""
    windows_of_run = [
        {
            "from_s": from_s,
            "to_s": to_s,
            "site": site,
            **dict.fromkeys(
                ExpectWindow.list_quantities(2) if site else ALL_SITES_QUANTITIES, (0, 0)
            ),
        }
        for from_s, to_s, site in windows
    ]
    return RunMetrics.of_virtual_run(
        load_scenario(name, {**(overrides or {}), "expect": {"windows": windows_of_run}})
    )


def find_peak(figures: RunMetrics, n: int = 0) -> float:
    """Returns the largest |e| of a window."""
    return figures.windows[n]["error_peak_rad"].most


def find_value(figures: RunMetrics, key: str, n: int = 0) -> float:
    """Returns a quantity of a window that has one value."""
    return figures.windows[n][key].most


def approximate_figure(figure: float, digit: float) -> Any:
    """Returns an approximation within the last printed digit or 2 %, whichever is larger."""
    return pytest.approx(figure, abs=max(digit, 0.02 * abs(figure)))
