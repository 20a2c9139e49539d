"""Reads the scenario of a session for the recorder, which knows nothing of scenarios."""

from recorder.record_process import ReadScenario, RecordedScenario

from ..log.ros2.viz_channels import offer_views
from ..scenario import parse_embedded


def make_scenario_reader(views_hz: float = 0.0) -> ReadScenario:
    """Returns the function with which a recorder reads the scenario of its session.

    Args:
        views_hz: Rate of the messages for viewers in the log, in Hz, see
            `log.ros2.viz_channels`. With 0, the log contains none.
    """

    def read_scenario(text: str, source: str) -> RecordedScenario:
        """Reads the text of a scenario that another process has sent."""
        scenario = parse_embedded(text, source)
        return RecordedScenario(scenario, offer_views(scenario, views_hz))

    return read_scenario
