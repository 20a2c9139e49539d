"""Computes a fingerprint of the platform's arithmetic, to tell whether a run repeats exactly.

The same program can produce results that differ in the last bit between platforms. Every log
contains the fingerprint of the platform that wrote it. Verifying a log recomputes the run, and
its results are required to match to the last bit only if the fingerprint of the current
platform is the same (law L5 of docs/develop/design.md).

The fingerprint is a hash of the results of a fixed computation: many sines and cosines, and a
short simulation of two arms that follow each other over a network with random delays.
"""

import hashlib
from functools import cache

import numpy as np

from ..arms.elementary import sincos
from ..arms.exogenous import TorqueKind, TorqueSource
from ..arms.two_link_arm import PARAMETERS, ArmLinks
from ..links.delay import DelayKind, LinkModel
from .jit import leaf
from .site_setup import Gains, Law, LinkSetup, SiteSetup
from .site_step import Site
from .ticks import Arrival, TickInput
from .vectors import Array

_TICKS = 200
_LINK = LinkModel(kind=DelayKind.GAMMA, extra=2.7, scale=900.0, playout_us=2_000)


@leaf
def _compute_sines(angles: Array, results: Array) -> None:
    """Computes the sines and cosines that go into the fingerprint.

    Of all operations, these are the most likely to differ between platforms.

    Args:
        angles: The angles, shape (n,), rad.
        results: Output array of shape (2, n), for the sines in the first row and the cosines in
            the second.
    """
    for n in range(angles.shape[0]):
        results[0, n], results[1, n] = sincos(angles[n])


def _build_setup(name: str, peer: str, q0: tuple[float, float]) -> SiteSetup:
    """Returns the setup of one of the two arms simulated for the fingerprint.

    The values are arbitrary, but must never change, because the fingerprint depends on them.

    Args:
        name: Name of the site.
        peer: Name of its only peer.
        q0: Start pose, rad.
    """
    links = ArmLinks(
        l1_m=1.0,
        m1_kg=1.1,
        lc1_m=0.5,
        I1_kg_m2=0.09,
        l2_m=0.9,
        m2_kg=0.8,
        lc2_m=0.4,
        I2_kg_m2=0.05,
    )
    theta = links.theta()
    return SiteSetup(
        name=name,
        rate_hz=1000,
        digital=False,
        gains=Gains(
            Law.ADAPTIVE,
            Lambda=(1.0, 1.3),
            Kp=(1.0, 0.7),
            Kd=(3.0, 2.1),
            Gamma=(1.0,) * PARAMETERS,
            theta_hat0=(0.3 * theta).tolist(),
        ),
        theta=theta,
        g_m_s2=9.81,
        lengths_m=(1.0, 0.9),
        tau_limit_nm=200.0,
        qd_limit_rad_s=100.0,
        q0=q0,
        qd0=(0.1, -0.2),
        actors=(TorqueSource(TorqueKind.PULSE, 0.01, 0.15, a=(3.0, 2.0)),),
        links=(
            LinkSetup(
                peer=peer, alpha=1.0, rate_hz=1000, q0=(0.0, 0.0), key=7, models=(_LINK,)
            ),
        ),
    )


@cache
def compute_fingerprint() -> str:
    """Returns a fingerprint of this platform's arithmetic, as sixteen hexadecimal digits.

    Two platforms with the same fingerprint can be expected to compute bit-identical results.
    See the module docstring for what is hashed.
    """
    angles = np.linspace(-12.0, 12.0, 4001)
    results = np.empty((2, len(angles)))
    _compute_sines(angles, results)
    digest = hashlib.sha256(results.tobytes())
    a = Site(_build_setup("a", "b", (0.6, -0.4)))
    b = Site(_build_setup("b", "a", (-0.5, 0.8)))
    record_a = a.step(TickInput(0))
    record_b = b.step(TickInput(0))
    for k in range(1, _TICKS):
        from_b = Arrival(0, k - 1, record_b.q, record_b.qd)
        from_a = Arrival(0, k - 1, record_a.q, record_a.qd)
        record_a = a.step(TickInput(k, [from_b]))
        record_b = b.step(TickInput(k, [from_a]))
        for record in (record_a, record_b):
            numbers = [*record.q, *record.qd, *record.tau, *record.theta_hat]
            digest.update(np.array(numbers).tobytes())
    return digest.hexdigest()[:16]
