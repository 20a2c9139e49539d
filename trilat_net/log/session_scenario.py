"""Defines the few facts about an experiment that a log and its recorder need.

A recorder stores the messages of a session without understanding the experiment. For example,
it needs the names of the arms and the duration of the run, but no control law. It therefore
depends on the classes here, and not on the program that reads scenarios (descriptions of
experiments). `scenario.Scenario` has all of these facts.
"""

from collections.abc import Mapping
from typing import Protocol

from ..records import Layout


class _SiteRate(Protocol):
    """A site of a scenario, which runs one arm."""

    @property
    def rate_hz(self) -> int:
        """Rate of the control loop of a site (arm controller), in Hz.

        It relates numbers of control periods to times: period 500 at 1000 Hz is at 0.5 s.
        """


class SessionScenario(Protocol):
    """Interface: the settings of a session on which the messages in its log depend.

    `scenario.Scenario` has these attributes. The recorder depends only on this protocol, so
    that it need not import the program that reads scenarios.
    """

    @property
    def name(self) -> str:
        """Name of the scenario (the settings that define a run), such as "paper"."""

    @property
    def seed(self) -> int:
        """Seed of the random numbers of a run. The same seed gives the same network delays."""

    @property
    def duration_s(self) -> float:
        """Planned duration of the run, in s. The run is shorter if an arm leaves its limits."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sites (arm controllers), in the order of the scenario file.

        Example: ("m1", "m2", "s"), two masters and a slave.
        """

    @property
    def sites(self) -> Mapping[str, _SiteRate]:
        """The sites (arm controllers) by name, each with the rate of its control loop."""

    @property
    def text(self) -> str:
        """The scenario as TOML in canonical form, in which equal settings give equal text.

        A log contains this text, so that the run can be repeated from the log.
        """

    @property
    def sha256(self) -> str:
        """SHA-256 hash of `text`, with which processes check that they have equal scenarios."""

    @property
    def sites_may_return(self) -> bool:
        """True if sites may leave the session and return while it runs.

        The recorder and the checks of a log then accept that a site starts again.
        """

    def ticks(self, site: str) -> int:
        """Returns how many control periods (ticks) a site executes in the whole run.

        The number is the duration times the rate of the control loop.

        Args:
            site: Name of the site.
        """

    def layout(self, site: str) -> Layout:
        """Returns the lengths of the vectors in a site's records, such as its number of joints.

        A reader of the log needs them to decode the records.

        Args:
            site: Name of the site.
        """
