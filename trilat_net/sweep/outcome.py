"""What became of one cell of a sweep.

Law: it is a function of the cell's scenario and of how long it may be extended, and of nothing else.
"""

from enum import StrEnum

import msgspec

from ..certificate.ending import Motion


class Verdict(StrEnum):
    """What a cell is; the text is the word for people and in results."""

    CONVERGED = "converged"
    BOUNDED = "bounded oscillation"
    DIVERGED = "diverged"
    UNDECIDED = "undecided"

    @property
    def stable(self) -> bool | None:
        """True where errors die away, False where they stay or grow; None where nobody knows."""
        return None if self is Verdict.UNDECIDED else self is Verdict.CONVERGED


VERDICT_OF = {
    Motion.CONVERGED: Verdict.CONVERGED,
    Motion.DECAYS: Verdict.CONVERGED,
    Motion.BOUNDED: Verdict.BOUNDED,
    Motion.GROWS: Verdict.DIVERGED,
    Motion.DIVERGED: Verdict.DIVERGED,
    Motion.UNDECIDED: Verdict.UNDECIDED,
}
"""What is called what, of the motions that `certificate.growth` tells."""


class Outcome(msgspec.Struct, frozen=True):
    """One cell, run and judged.

    Attributes:
        verdict: what it is.
        motion: the word of the certificate, which tells growing from diverged and decaying from converged.
        ran_s: how long it ran in the end, extensions and an early stop included, s.
        extended: how often its time was doubled because it had not been decided.
        end_error_rad: the largest abs(e) of the last second, rad.
        end_speed_rad_s: the largest abs(qd) of the last second, rad/s.
        error_rate_per_s: the trend of abs(e) over the second half: it goes as exp(rate t), 1/s; None where it
            has none.
        speed_rate_per_s: the same of abs(qd).
        peak_error_rad: the largest abs(e) of the run, rad.
        settled_s: since when abs(e) is below 0.01 rad; None where it is not at the end.
        diverged_s: when the first site left its limits, or None.
    """

    verdict: Verdict
    motion: Motion
    ran_s: float
    extended: int
    end_error_rad: float
    end_speed_rad_s: float
    error_rate_per_s: float | None
    speed_rate_per_s: float | None
    peak_error_rad: float
    settled_s: float | None
    diverged_s: float | None
