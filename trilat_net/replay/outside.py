"""The laws from outside that executing a log runs.

Law: whoever executes a log is told, before, what of it is code that the log names and does not hold.
"""

from typing import NamedTuple

from ..errors import ScenarioError
from ..scenario import Scenario
from ..scenario.own_law import Own


class OutsideLaw(NamedTuple):
    """A law that a log names.

    Attributes:
        code: where it is, as in "package.module:Law".
        sites: whose law it is.
        changed: how its file differs from the one that ran; "" where it does not.
    """

    code: str
    sites: tuple[str, ...]
    changed: str

    def __str__(self) -> str:
        told = f"its file was changed, {self.changed}" if self.changed else "its file is the one that ran"
        return f"{self.code} of {', '.join(self.sites)}; {told}"


def outside_laws(scenario: Scenario, source: str = "") -> list[OutsideLaw]:
    """Returns the laws from outside of a scenario; nothing of them runs.

    Args:
        scenario: as a log holds it.
        source: what errors call it.

    Raises:
        ScenarioError: the file of one is not there.
    """
    laws: dict[tuple[str, str], tuple[Own, list[str]]] = {}
    for name, spec in scenario.sites.items():
        if isinstance(spec.control, Own):
            law = spec.control
            laws.setdefault((law.code, law.source_sha256), (law, []))[1].append(name)
    found = []
    for law, sites in laws.values():
        try:
            changed = law.changed() or ""
        except ScenarioError as error:
            raise ScenarioError(error.problem, path=f"sites.{sites[0]}.control", source=source) from None
        found.append(OutsideLaw(law.code, tuple(sites), changed))
    return found
