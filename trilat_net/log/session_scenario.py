"""Defines the few facts about an experiment that a log and its recorder need.

A recorder stores the messages of a session without knowing much about the experiment. For
example, it needs the names of the arms and the duration of the run, but no control law. It
therefore depends only on the protocols defined here, and not on the code that reads scenarios.
`scenario.Scenario` provides all of these facts.
"""

from collections.abc import Mapping
from typing import Protocol

from ..records import Layout


class _SiteRate(Protocol):
    """A site of a scenario, which runs one arm."""

    @property
    def rate_hz(self) -> int:
        """Rate of the control loop of a site, in Hz.

        Used to convert ticks to times: at 1000 Hz, tick 500 is at 0.5 s.
        """


class SessionScenario(Protocol):
    """Protocol for the settings of a session that determine the messages in its log.

    `scenario.Scenario` has these attributes. The recorder depends only on this protocol, which
    avoids importing the code that reads scenarios.
    """

    @property
    def name(self) -> str:
        """Name of the scenario, such as "paper"."""

    @property
    def seed(self) -> int:
        """Seed of the random numbers of a run. The same seed yields the same network delays."""

    @property
    def duration_s(self) -> float:
        """Planned duration of the run, in s. A run is shorter if an arm exceeds its limits."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sites, in scenario order.

        Example: ("m1", "m2", "s"), two masters and a slave.
        """

    @property
    def sites(self) -> Mapping[str, _SiteRate]:
        """Maps the name of each site to an object with the rate of its control loop, in Hz."""

    @property
    def text(self) -> str:
        """The scenario as TOML in canonical form, in which equal settings yield equal text.

        A log contains this text, so that the run can be repeated from the log.
        """

    @property
    def sha256(self) -> str:
        """SHA-256 hash of `text`, used to check that processes have the same scenario."""

    @property
    def sites_may_return(self) -> bool:
        """True if sites may leave the session and return while it runs.

        The recorder and the checks of a log then accept that a site restarts.
        """

    def ticks(self, site: str) -> int:
        """Returns how many ticks a site executes in a complete run.

        This is the duration times the rate of the control loop.

        Args:
            site: Name of the site.
        """

    def layout(self, site: str) -> Layout:
        """Returns the lengths of the vectors in a site's records, for example 2 joint angles.

        Readers of the log need these lengths to decode the records.

        Args:
            site: Name of the site.
        """
