"""The root that decides: the rightmost one that is not zero by structure.

Law: of a plain digital controller the loop counts as it is computed, tick by tick, which the continuous one
only approximates.
"""

import numpy as np

from ..core.setup import Scheme
from ..scenario import Scenario
from .conditions import Conditions
from .loop import Rest, loop_of
from .roots import spectrum
from .sampled import sampled_spectrum
from .spectrum import Root

_NEAR = 4
"""So many continuous roots lead to the sampled ones."""


def digital(scenario: Scenario) -> bool:
    """True where the controllers are plain digital ones."""
    return scenario.scheme == Scheme.DIGITAL.name.lower()


def rightmost(now: Conditions, rest: Rest, *, sampled: bool) -> Root | None:
    """Returns the rightmost root; None where there is none but those at zero.

    Args:
        now: what holds.
        rest: where it is linearised.
        sampled: whether the loop as it is computed counts; at several rates the continuous one does.
    """
    continuous = spectrum(loop_of(now, rest), _NEAR if sampled else 1)
    if not sampled:
        return continuous.rightmost
    near = np.array([root.s for root in continuous.roots], dtype=np.complex128)
    return (sampled_spectrum(now, rest, near, 1) or continuous).rightmost
