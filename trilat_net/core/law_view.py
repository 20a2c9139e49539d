"""What a plugged control law gets to see of a tick, filled into the site's row and the rows of its links.

Invariant: of one tick the compiled and the plain form of a law see the same numbers. What a law sends stays
in force until it writes it anew.
"""

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np

from . import chain_stages, two_link_stages
from .jit import leaf
from .law_channel import SentVector, join_received
from .site_arrays import SiteArrays
from .site_setup import SiteSetup
from .ticks import tick_ns
from .user_law import LawInput, PeerView
from .vectors import Array, Row, RowArray


@leaf
def _update_model(s: Row, chain: RowArray | None) -> None:
    if chain is None:
        two_link_stages.update_model(s)
    else:
        chain_stages.update_model(s, chain)


@leaf
def update_law_view(k: int, t_ns: int, site: RowArray, links: RowArray, chain: RowArray | None) -> None:
    """Writes what a law sees of a tick that no stage wrote: time, model, peers; and no torque yet."""
    s: Row = site[0]
    s.k, s.t_s, s.h_s = k, k / s.rate_hz, 1.0 / s.rate_hz
    for i in range(s.tau.shape[0]):
        s.tau_x[i] = 0.0 - s.on_arm[i]
        s.tau[i] = np.nan
    if s.theta_known != 0:
        _update_model(s, chain)
    for j in range(links.shape[0]):
        link: Row = links[j]
        link.tick = link.used
        link.age_s = (t_ns - tick_ns(max(link.used, 0), link.rate_hz)) * 1e-9


_OF_SITE = (
    *("q", "qd", "q_des", "qd_des", "felt", "tau_x", "tau_before", "q_before", "tau", "theta_hat"),
    *("gravity", "inertia", "bias"),
)
_IN_ROW = {"gravity": "G", "inertia": "M"}
"""Where names of a law's input differ from those of the site's row."""


def _name_vectors(vectors: Sequence[SentVector], numbers: list[float]) -> SimpleNamespace:
    """Returns numbers by the names of the vectors that they are."""
    named, first = SimpleNamespace(), 0
    for vector in vectors:
        setattr(named, vector.name, numbers[first : first + vector.length])
        first += vector.length
    return named


class PlainView:
    """The input of a law in plain Python, made of lists, and what it sends.

    Args:
        setup: of its site.
        arrays: of its site.
        sent: the numbers that its record names as sent, see `LawChannel`.
    """

    def __init__(self, setup: SiteSetup, arrays: SiteArrays, sent: Array) -> None:
        site, links = arrays.site[0], arrays.links
        self._rate_hz = setup.rate_hz
        self._of_site = [site[_IN_ROW.get(name, name)] for name in _OF_SITE]
        self._of_peers = [links[name] for name in PeerView._fields]
        self._counts = (setup.layout.joints, setup.layout.shared)
        self._received = None if arrays.channel is None else arrays.channel.received
        self._receives = join_received([link.channel for link in setup.links])
        self._sends = {
            per_peer: [vector for vector in setup.channel.vectors if vector.per_peer is per_peer]
            for per_peer in (False, True)
        }
        self._sent = sent
        self._common = setup.channel.numbers(per_peer=False)
        self._own = setup.channel.numbers(per_peer=True)

    def read(self, k: int) -> LawInput:
        """Returns the input of tick k, after `update_law_view`."""
        vectors = dict(zip(_OF_SITE, [vector.tolist() for vector in self._of_site], strict=True))
        columns = [column.tolist() for column in self._of_peers]
        peers = tuple(map(PeerView, *columns))
        received = () if self._received is None else self._received.tolist()
        sent, common = self._sent.tolist(), self._common
        return LawInput(
            k=k,
            t_s=k / self._rate_hz,
            h_s=1.0 / self._rate_hz,
            joints=self._counts[0],
            coordinates=self._counts[1],
            peers=peers,
            received=tuple(_name_vectors(self._receives, numbers) for numbers in received),
            sent=tuple(
                _name_vectors(self._sends[True], sent[common + j * self._own :]) for j in range(len(peers))
            ),
            to_all=_name_vectors(self._sends[False], sent),
            **vectors,
        )

    def take_sent(self, now: LawInput) -> None:
        """Takes in what the law sends.

        Raises:
            ValueError: a vector has another length than the law declares.
        """
        sent: list[float] = []
        for per_peer, names in ((False, [now.to_all]), (True, now.sent)):
            for place, named in enumerate(names):
                for vector in self._sends[per_peer]:
                    values = list(getattr(named, vector.name))
                    if len(values) != vector.length:
                        where = f"sent[{place}]" if per_peer else "to_all"
                        problem = f"has {len(values)} numbers, not {vector.length}"
                        raise ValueError(f"{where}.{vector.name} {problem}")
                    sent += values
        self._sent[:] = sent
