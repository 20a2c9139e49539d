"""What the controllers' torques cost.

Law: of the torque that the record names, Eq. (13) within its limit; it holds up gravity too.
"""

import numpy as np

from ..analysis import quantities
from ..log.reader import Log
from .said import Facts, peak, rms, said, unsaid

SITE = ("effort_nm2_s", "rms_tau_nm", "peak_tau_nm", "saturated_share")


def of_site(log: Log, site: str) -> Facts:
    """Returns effort and saturation of a site."""
    part, spec = log[site], log.scenario.sites[site]
    if not len(part):
        return unsaid(SITE, f"no records of {site}")
    tau = quantities.control_torques(part)
    at_limit = np.any(np.abs(tau) >= spec.limits.tau_limit_nm, axis=1)
    return {
        "effort_nm2_s": said(float(np.einsum("kj,kj->", tau, tau)) / part.rate_hz),
        "rms_tau_nm": said(rms(tau)),
        "peak_tau_nm": said(peak(tau)),
        "saturated_share": said(float(at_limit.mean())),
    }
