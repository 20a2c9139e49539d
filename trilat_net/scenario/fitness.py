"""Whether a law fits its site: what it needs to know of the arm, and how many sites it is for.

Law: what a law needs and a scenario does not give is refused before anything runs, with the reason.
"""

from ..errors import ScenarioError
from .laws import AdaptiveBox, ForceReflecting, ProportionalDamped, ProportionalDerivativeDamped
from .site import SiteSpec

PAIR = 2
"""Sites of direct force reflection: one master, one slave."""


def check_fitness(name: str, site: SiteSpec, sites: int) -> None:
    """Refuses a law that its site cannot carry out, and an arm that is not what its plant says.

    Args:
        name: the site's name.
        site: the site.
        sites: how many there are in the experiment.

    Raises:
        ScenarioError: with the path of the key.
    """
    path, law = f"sites.{name}", site.control
    outside = site.plant == "external"
    if not site.arm.known and not outside:
        raise ScenarioError(
            "a simulated arm moves by its masses: leave it true, or set plant = 'external' for an arm "
            "outside of the program",
            path=f"{path}.arm.known",
        )
    if isinstance(law, AdaptiveBox):
        _check_box(law, f"{path}.control")
    if isinstance(law, ForceReflecting) and sites != PAIR:
        raise ScenarioError(
            f"p_f reflects the force of one slave to one master, and here are {sites} sites: with more of "
            "them it is not said whose contact a site feels; choose p_d, pd_d or adaptive, or two sites",
            path=f"{path}.control.law",
        )
    if (
        isinstance(law, ProportionalDamped | ProportionalDerivativeDamped | ForceReflecting)
        and not site.arm.known
        and law.gravity * site.arm.g_m_s2 > 0.0
    ):
        raise ScenarioError(
            f"{law.__struct_config__.tag} takes gravity from the arm's masses, which nobody knows "
            "(arm.known = false): set gravity = 0 if the arm carries itself, arm.g_m_s2 = 0 if it moves in a "
            "horizontal plane, or choose adaptive, which learns it",
            path=f"{path}.control.gravity",
        )
    for group in ("hands", "environment") if outside else ():
        if getattr(site, group):
            raise ScenarioError(
                "an arm outside of the program is pushed outside of it: leave them out",
                path=f"{path}.{group}",
            )


def _check_box(law: AdaptiveBox, path: str) -> None:
    """Refuses a box without an inside, and a first estimate that is not in it."""
    for n, (low, first, high) in enumerate(zip(law.theta_low, law.theta_hat0, law.theta_high, strict=True)):
        if low > high:
            raise ScenarioError(
                f"must be at least theta_low = {low:g}, is {high:g}", path=f"{path}.theta_high[{n}]"
            )
        if not low <= first <= high:
            raise ScenarioError(
                f"must lie in its box from {low:g} to {high:g}, is {first:g}", path=f"{path}.theta_hat0[{n}]"
            )
