"""Provides the recorder with a function that reads the scenario of the recorded session.

The recorder stores messages, and must not depend on the modules that interpret scenarios. The
program that starts the recorder therefore passes this function to it.
"""

from typing import Any

from recorder import ReadScenario

from ..hooks import find_hook
from ..scenario import Scenario, parse_embedded


def make_scenario_reader(views_hz: float = 0.0) -> ReadScenario:
    """Returns the function with which a recorder reads the scenario of its session.

    Args:
        views_hz: Rate at which messages for viewers are written to the log, in Hz; see
            `log.view_rates`. With 0, the log contains no such messages.
    """

    def read_scenario(text: str, source: str) -> tuple[Scenario, Any]:
        """Reads the scenario sent by a process of the session.

        Args:
            text: TOML text of the scenario.
            source: Where the scenario comes from, for error messages.

        Returns:
            The scenario, and the function that creates the messages for viewers.
        """
        scenario = parse_embedded(text, source)
        make_views = find_hook("offer the views of a log")(scenario, views_hz)
        return scenario, make_views

    return read_scenario
