"""The Python interface: everything that `import trilat_net` offers.

Invariant: no logic here but joining rooms: scenario, virtual time, log, execution, analysis, studies.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .execution.virtual import simulate_scenario
from .log.log_reader import Log
from .scenario import Scenario, load_scenario


def simulate(
    scenario: str | Path | Scenario,
    set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the command's --set, by its name
) -> Log:
    """Runs a scenario in virtual time and returns its log.

    Args:
        scenario: the name of a shipped scenario, a path, or a scenario.
        set: overrides, as in `{"control.Kd": 5}`.

    Raises:
        ScenarioError: the scenario or an override is not valid.
    """
    return simulate_scenario(load_scenario(scenario, set))
