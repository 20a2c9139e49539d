"""Every figure that there is: its name, what it shows, and when a log has nothing to show in it.

Law: a figure is a function of a log and of what it is drawn for; nothing else enters it.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from ..analysis import ages, authority, motion, operation, poses, settling, timing
from ..analysis.form import Form
from ..analysis.quantities import sites_with_hands
from ..certificate.certificate import certify
from ..certificate.figure import functional_over_time
from ..certificate.premises import of_scenario
from ..experiment import twin_without_hands
from ..log.reader import Log
from . import contact

NOTHING_LEARNT = "no estimate changed in this run"


class Plate(NamedTuple):
    """A figure.

    Attributes:
        about: what it shows, in a few words.
        draw: makes it.
        absent: says why a log has nothing for it; "" where it has.
    """

    about: str
    draw: Callable[[Log, Form], Figure]
    absent: Callable[[Log], str] = lambda _: ""


def _no_hands(log: Log) -> str:
    return "" if sites_with_hands(log) else motion.NO_HANDS


def _no_script(log: Log) -> str:
    return "" if any(site.hands for site in log.scenario.sites.values()) else motion.NO_HANDS


def _no_walls(log: Log) -> str:
    return "" if contact.sites_with_walls(log) else contact.NO_WALLS


def _no_clock(log: Log) -> str:
    return "" if timing.has_clock(log) else timing.no_clock_text(log)


def _no_functional(log: Log) -> str:
    law = of_scenario(log.scenario)[0]
    return "" if law.holds else law.text


def _nothing_learnt(log: Log) -> str:
    learnt = any(len(log[site]) and np.ptp(log[site].theta_hat, axis=0).any() for site in log.sites)
    return "" if learnt else NOTHING_LEARNT


def _hands_moved(log: Log, form: Form) -> Figure:
    return motion.hands_moved(log, twin_without_hands(log), form)


def _certificate(log: Log, form: Form) -> Figure:
    return functional_over_time(log, certify(log), form)


PLATES = {
    "operation": Plate("torque on the arms above their angles", operation.operation, _no_hands),
    "operator_torques": Plate("torque on the arms (Fig. 3)", motion.operator_torques, _no_hands),
    "positions": Plate("actual and desired angles (Fig. 4)", motion.positions),
    "tracking_errors": Plate("errors, and the largest one still to come (Fig. 5)", motion.tracking_errors),
    "settling": Plate("size of the errors on a log axis, settling times", settling.settling),
    "phase": Plate("errors against their rates", settling.phase),
    "parameter_estimates": Plate(
        "estimates and true values (Fig. 6)",
        lambda log, form: motion.parameter_estimates(log, None, form),
        _nothing_learnt,
    ),
    "control_torques": Plate("torque of the controllers", operation.control_torques),
    "hands_moved": Plate("the log minus the same run without hands", _hands_moved, _no_script),
    "contact": Plate("force of the walls, and depth in them", contact.contact, _no_walls),
    "authority": Plate(
        "shares that change, and where the arms went",
        authority.authority,
        lambda log: "" if authority.changing(log) else authority.CONSTANT,
    ),
    "certificate": Plate("V, its parts, who changed it, the energy balance", _certificate, _no_functional),
    "arms": Plate("the arms at a few instants", lambda log, form: poses.arms(log, None, form)),
    "sample_age": Plate("age of the samples in use, per link", ages.sample_age),
    "delay_distributions": Plate(
        "delays and ages, how often",
        ages.delay_distributions,
        lambda log: "" if ages.varied(log) else ages.NO_JITTER,
    ),
    "loop_timing": Plate("lateness and computing time of the loops", timing.loop_timing, _no_clock),
}
"""By name, in the order in which a paper has them."""
