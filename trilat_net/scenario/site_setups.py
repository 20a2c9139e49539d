"""Converts a scenario to the numbers from which the kernel builds the control loop of a site.

`Scenario.setup` calls this module and keeps the result.

Invariant:
    - The settings of a site include those of its links with all planned changes, since a sample
      is delayed as the link was when the sample was sent.
"""

from typing import TYPE_CHECKING

import numpy as np

from ..core import Array, LinkSetup, RestGains, SiteSetup, link_key
from .delay_models import LinkBase

if TYPE_CHECKING:
    from .scenario_types import Scenario


def build_site_setup(scenario: "Scenario", site: str) -> SiteSetup:
    """Returns the settings from which the compiled control loop of a site is built.

    Args:
        scenario: The scenario.
        site: Name of the site.
    """
    spec = scenario.sites[site]
    arm = scenario.arms[site]
    index = scenario.names.index(site)
    control = scenario.controls[index]
    rest_gains = RestGains()
    if spec.on_stale.action == "glide":
        rest_gains = _compute_rest_gains(scenario, site)
    return SiteSetup(
        name=site,
        rate_hz=spec.rate_hz,
        digital=scenario.is_digital,
        gains=scenario.gains(site),
        theta=arm.theta,
        g_m_s2=spec.arm.g_m_s2,
        lengths_m=arm.lengths_m,
        tau_limit_nm=spec.limits.tau_limit_nm,
        qd_limit_rad_s=spec.limits.qd_limit_rad_s,
        q0=spec.q0_rad,
        qd0=spec.qd0_rad_s,
        actors=spec.actors,
        links=tuple(_build_link_setup(scenario, peer, site) for peer in scenario.peers(site)),
        ramps=tuple(scenario.scripted_ramps(site)),
        on_stale=spec.on_stale.rule,
        external=spec.plant != "simulated",
        law_factory=control.build_factory(len(scenario.sites), scenario.scheme),
        theta_known=spec.arm.known,
        chain=arm.chain,
        channel=scenario.channel(site),
        bodies=len(scenario.bodies_m(site)),
        limits=scenario.motion_limits(site),
        rest=rest_gains,
        bit=1 << index,
    )


def _compute_rest_gains(scenario: "Scenario", site: str) -> RestGains:
    """Returns the gains of the controller that brings an arm to rest.

    This controller acts, for example, when a peer has fallen silent. The gains depend on
    the inertia of the arm, its torque limits, the control period, and the damping of the
    control law.
    """
    spec = scenario.sites[site]
    arm = scenario.arms[site]
    gains = spec.control.linear_gains(arm.theta) or spec.control.gains(arm.theta)
    # the damping that the law of the site already has, on each joint
    law_damping: Array = np.zeros(arm.counts.joints) + gains.Kp + gains.d
    return arm.compute_rest_gains(
        q0=spec.q0_rad,
        law_damping=law_damping,
        limit_nm=spec.limits.tau_limit_nm,
        rate_hz=spec.rate_hz,
        known=spec.arm.known,
    )


def _build_link_setup(scenario: "Scenario", peer: str, site: str) -> LinkSetup:
    """Returns the link between two sites in the format read by the compiled simulation.

    Includes the planned changes of the link.

    Args:
        scenario: The scenario.
        peer: Name of the sender.
        site: Name of the receiver.
    """
    name = f"{peer}->{site}"
    first_link = scenario.links[name]
    later_links = scenario.scheduled_links(name)
    links: list[tuple[int, LinkBase]] = [(0, first_link), *later_links]
    peer_index = scenario.names.index(peer)
    speed_limit: tuple[float, ...] = ()
    if scenario.sites[site].on_stale.action == "glide":
        speed_limit = _find_speed_limit(scenario, peer)
    return LinkSetup(
        peer=peer,
        alpha=scenario.dominance[site].get(peer, 0.0),
        rate_hz=scenario.sites[peer].rate_hz,
        q0=scenario.arms[peer].shared_pose(scenario.sites[peer].q0_rad),
        key=link_key(scenario.seed, name),
        models=tuple(link.to_core_model(from_ns) for from_ns, link in links),
        traces=tuple(link.points for _, link in links),
        outages=tuple(
            (round(start_s * 1e9), round(end_s * 1e9))
            for start_s, end_s in first_link.outages_s
        ),
        channel=scenario.channel(peer),
        index_at_peer=scenario.peers(peer).index(site),
        speed_limit=speed_limit,
        bit=1 << peer_index,
        followed=_mask_followed_sites(scenario, peer_index),
        dispensable=scenario.sites[peer].role == "master",
    )


def _mask_followed_sites(scenario: "Scenario", index: int) -> int:
    """Returns the sites that a site follows, as a bit mask with bit n set for site n.

    For example, 0b101 stands for the first and the third site. The compiled code requires
    this form.
    """
    return sum(1 << n for n, share in enumerate(scenario.alpha[index]) if share > 0.0)


def _find_speed_limit(scenario: "Scenario", site: str) -> tuple[float, ...]:
    """Returns the speed limit of each joint of an arm, in rad/s.

    Empty if the arms follow each other's end effectors.
    """
    spec = scenario.sites[site]
    joints = scenario.arms[site].counts.joints
    if spec.task.space != "joints":
        return ()
    return tuple(np.broadcast_to(spec.limits.qd_limit_rad_s, joints).tolist())
