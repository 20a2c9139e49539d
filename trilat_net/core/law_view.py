"""The view of a tick that a plugged control law gets, in the rows of its site and links.

Invariant:
    - The compiled and the plain form of a law see the same numbers.
    - A sent vector keeps its numbers until the law writes it again.
"""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from ..errors import count_nouns
from . import chain_stages, two_link_stages
from .jit import bind_leaf, leaf
from .law_channel import SentVector
from .site_arrays import SiteArrays
from .site_setup import SiteSetup
from .ticks import tick_ns
from .user_law import LawInput, LawVector, PeerView, UserLaw, call_law, read_memory, restore_law
from .vectors import Array, Row, RowArray


@leaf
def _update_model(s: Row, chain: RowArray | None) -> None:
    if chain is None:
        two_link_stages.update_model(s)
    else:
        chain_stages.update_model(s, chain)


@leaf
def update_law_view(
    k: int, t_ns: int, site: RowArray, links: RowArray, chain: RowArray | None
) -> None:
    """Writes the parts of a law's view that no stage has written: time, model and peers.

    The torque becomes NaN, so that a torque which the law does not write is found.
    """
    s: Row = site[0]
    s.k = k
    s.t_s = k / s.rate_hz
    s.h_s = 1.0 / s.rate_hz
    for i in range(s.tau.shape[0]):
        s.tau_x[i] = 0.0 - s.on_arm[i]
        s.tau[i] = np.nan
    if s.theta_known != 0:
        _update_model(s, chain)
    for j in range(links.shape[0]):
        link: Row = links[j]
        link.tick = link.used
        link.age_s = (t_ns - tick_ns(max(link.used, 0), link.rate_hz)) * 1e-9


_PER_JOINT = ("q", "qd", "tau_x", "tau_before", "q_before", "tau", "gravity", "bias")
_PER_COORDINATE = ("q_des", "qd_des", "felt")
_IN_ROW = {"gravity": "G"}
"""Fields of the site's row whose names differ from those of a law's input."""


def _name_vectors(vectors: Sequence[SentVector], numbers: list[float]) -> SimpleNamespace:
    """Returns a namespace of vectors, filled with consecutive numbers."""
    named = SimpleNamespace()
    first = 0
    for vector in vectors:
        setattr(named, vector.name, LawVector(numbers[first : first + vector.length]))
        first += vector.length
    return named


class PlainLaw:
    """A law in plain Python at its site.

    The law gets lists, and its results are written into the site's row.

    Args:
        law: the law.
        setup: the setup of the site.
        arrays: the arrays of the site; their vectors may be longer than the site's.
        sent: the sent vectors in the site's record, see `LawChannel`.
    """

    def __init__(self, law: UserLaw, setup: SiteSetup, arrays: SiteArrays, sent: Array) -> None:
        self._law = law
        self._setup = setup
        self._arrays = arrays
        self._sent = sent
        self._update = update_law_view
        site = arrays.site[0]
        layout = setup.layout
        n = layout.joints
        m = layout.shared
        views = {name: site[_IN_ROW.get(name, name)][:n] for name in _PER_JOINT}
        views |= {name: site[name][:m] for name in _PER_COORDINATE}
        self._views = {**views, "theta_hat": site["theta_hat"][: layout.parameters]}
        self._inertia = site["M"][:n, :n]
        self._limit = site["tau_limit"][:n]
        columns = [arrays.links[name] for name in PeerView._fields]
        self._of_peers = [column if column.ndim == 1 else column[:, :m] for column in columns]
        self._received = None if arrays.channel is None else arrays.channel.received
        self._receives = setup.received_vectors
        self._sends = {
            per_peer: setup.channel.select_vectors(per_peer=per_peer)
            for per_peer in (False, True)
        }
        self._to_all_size = setup.channel.count_numbers(per_peer=False)
        self._peer_size = setup.channel.count_numbers(per_peer=True)

    def bind(self) -> None:
        """Compiles the leaf that `compute` calls, and looks up its types once and for all."""
        a = self._arrays
        self._update = bind_leaf(update_law_view, 0, 0, a.site, a.links, a.chain)

    def compute(self, k: int, t_ns: int) -> list[float]:
        """Computes stage 6 of tick k, and returns the law's memory.

        Torque, estimate and sent vectors are written into the site's arrays.

        Raises:
            LawFailed: the law failed.
        """
        a = self._arrays
        setup = self._setup
        self._update(k, t_ns, a.site, a.links, a.chain)
        results = call_law(self._law, setup.name, self._read(k), self._collect_sent)
        self._views["tau"][:] = np.clip(results.torque, -self._limit, self._limit)
        self._views["theta_hat"][:] = results.theta_hat
        self._sent[:] = results.sent
        return results.memory

    @property
    def memory(self) -> list[float]:
        """The numbers that the law remembers now."""
        return read_memory(self._law)

    def restore(self, memory: Sequence[float]) -> None:
        """Restores the law from its memory."""
        restore_law(self._law, self._setup.name, memory)

    def _read(self, k: int) -> LawInput:
        """Returns the input of tick k, after `update_law_view`."""
        setup = self._setup
        columns: list[Any] = [column.tolist() for column in self._of_peers]
        # The last three columns are the vectors q, qd and tau_x.
        columns[4:] = [map(LawVector, rows) for rows in columns[4:]]
        peers = tuple(map(PeerView, *columns))
        received = () if self._received is None else self._received.tolist()
        sent = self._sent.tolist()
        to_peers = []
        for j in range(len(peers)):
            first = self._to_all_size + j * self._peer_size
            to_peers.append(_name_vectors(self._sends[True], sent[first:]))
        return LawInput(
            k=k,
            t_s=k / setup.rate_hz,
            h_s=1.0 / setup.rate_hz,
            joints=setup.layout.joints,
            coordinates=setup.layout.shared,
            peers=peers,
            received=tuple(_name_vectors(self._receives, numbers) for numbers in received),
            sent=tuple(to_peers),
            to_all=_name_vectors(self._sends[False], sent),
            inertia=LawVector(map(LawVector, self._inertia.tolist())),
            **{name: LawVector(view.tolist()) for name, view in self._views.items()},
        )

    def _collect_sent(self, now: LawInput) -> list[float]:
        """Returns the numbers of all vectors that the law sends, in the order of the record.

        Raises:
            ValueError: a vector has another length than the law declares.
        """
        sent = self._collect_vectors(now.to_all, "to_all", per_peer=False)
        for j, to_peer in enumerate(now.sent):
            sent += self._collect_vectors(to_peer, f"sent[{j}]", per_peer=True)
        return sent

    def _collect_vectors(self, vectors: Any, name: str, *, per_peer: bool) -> list[float]:
        """Returns the numbers of the vectors for all peers, or for one peer.

        Args:
            vectors: the law's values by name.
            name: name of these vectors in the law's input, for errors.
            per_peer: which of the declared vectors they are.

        Raises:
            ValueError: a vector has another length than the law declares.
        """
        numbers: list[float] = []
        for vector in self._sends[per_peer]:
            values = list(getattr(vectors, vector.name))
            if len(values) != vector.length:
                count = count_nouns(len(values), "number")
                raise ValueError(f"{name}.{vector.name} has {count}, not {vector.length}")
            numbers += map(float, values)
        return numbers
