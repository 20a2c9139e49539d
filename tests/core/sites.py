"""Sites of the shipped scenarios, stepped by hand or executed, and their records as text."""

from collections.abc import Iterable, Sequence
from typing import Any

from tests.core.channels import LINK_NAME
from trilat_net.core.links.delay import LinkModel
from trilat_net.core.links.philox import link_key
from trilat_net.core.step.site_setup import LinkSetup, SiteSetup
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import Arrival, TickInput, TickRecord
from trilat_net.core.step.vectors import Points
from trilat_net.execution import virtual
from trilat_net.scenario import load_scenario

VECTORS = ("q", "qd", "q_des", "qd_des", "tau", "tau_x", "theta_hat")


def setup(site: str = "m1", scenario: str = "paper", **overrides: Any) -> SiteSetup:
    """Returns the setup of a site; overrides with `__` for the dot."""
    return load_scenario(
        scenario, {key.replace("__", "."): value for key, value in overrides.items()}
    ).setup(site)


def one_link(rate_hz: int, peer_rate_hz: int, delay_ns: int) -> Site:
    """Returns a site with a single peer behind a constant delay, whose reference is the sample in use."""
    return linked(rate_hz, peer_rate_hz, [LinkModel(location=delay_ns / 1000)])


def linked(
    rate_hz: int,
    peer_rate_hz: int,
    models: Sequence[LinkModel],
    trace: Points | None = None,
    outages: tuple[tuple[int, int], ...] = (),
) -> Site:
    """Returns a site with a single peer behind any link, by the name and seed of `channels.channel`."""
    key, traces = link_key(1, LINK_NAME), (trace,) * len(models)
    link = LinkSetup(
        "peer", 1.0, peer_rate_hz, (0.5, -0.25), key, tuple(models), traces, outages
    )
    return Site(setup()._replace(rate_hz=rate_hz, links=(link,)))


def sample(tick: int, peer: int = 0) -> Arrival:
    """Returns a sample that carries its own number."""
    return Arrival(peer, tick, (1e-3 * (tick + 1), -1e-3 * (tick + 1)), (1e-4 * tick, 0.0))


def stepped(site: Site, ticks: Iterable[TickInput]) -> list[TickRecord]:
    return [site.step(tick) for tick in ticks]


def bits(output: TickRecord) -> str:
    """Returns all results of a tick, exactly, as text."""
    return " ".join(v.hex() for field in VECTORS for v in getattr(output, field)) + str(
        output[-2:]
    )


def executed(scenario: str, **overrides: object) -> list[str]:
    """Returns a virtual run, every record as text."""
    run = virtual.execute_virtual(
        load_scenario(scenario, {k.replace("__", "."): v for k, v in overrides.items()})
    )
    return [f"{site.name} {output.tick} {bits(output)}" for site, _, output in run]
