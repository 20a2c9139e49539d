"""Lists the few facts about an experiment that a log and its recorder need.

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
        """Rate of the site's control loop, in Hz, which relates ticks to times."""


class SessionScenario(Protocol):
    """The facts about a scenario from which the messages of its session follow.

    `scenario.Scenario` has these attributes. The recorder depends only on this protocol, so
    that it need not import the program that reads scenarios.
    """

    @property
    def name(self) -> str:
        """Name of the scenario."""

    @property
    def seed(self) -> int:
        """Seed of the scenario's random numbers."""

    @property
    def duration_s(self) -> float:
        """Duration of the run, in s."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sites, such as ("m1", "m2", "s"), in the order of the scenario file."""

    @property
    def sites(self) -> Mapping[str, _SiteRate]:
        """The sites by name."""

    @property
    def text(self) -> str:
        """The scenario as a TOML text in its canonical form, which the log contains."""

    @property
    def sha256(self) -> str:
        """SHA-256 hash of `text`."""

    @property
    def sites_may_return(self) -> bool:
        """True if sites may leave the session and return while it runs.

        The recorder and the checks of a log then accept that a site begins again.
        """

    def ticks(self, site: str) -> int:
        """Returns how many ticks a site executes in the whole run, from duration and tick rate.

        Args:
            site: Name of the site.
        """

    def layout(self, site: str) -> Layout:
        """Returns the lengths of the vectors in a site's records, such as its number of joints.

        Args:
            site: Name of the site.
        """
