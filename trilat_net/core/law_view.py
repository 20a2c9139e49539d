"""What a plugged control law gets to see of a tick, filled into the site's row and the rows of
its links.

Invariant: of one tick the compiled and the plain form of a law see the same numbers. What a law
sends stays in force until it writes it anew.
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
    """Writes what a law sees of a tick that no stage wrote: time, model, peers; and no torque
    yet.
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
"""Where names of a law's input differ from those of the site's row."""


def _name_vectors(vectors: Sequence[SentVector], numbers: list[float]) -> SimpleNamespace:
    """Returns numbers by the names of the vectors that they are."""
    named = SimpleNamespace()
    first = 0
    for vector in vectors:
        setattr(named, vector.name, LawVector(numbers[first : first + vector.length]))
        first += vector.length
    return named


class PlainLaw:
    """A law in plain Python at its site: it gets lists, and its results are written into the
    site's row.

    Args:
        law: the law.
        setup: of its site.
        arrays: of its site; its vectors may be longer than the site's.
        sent: what its record names as sent, see `LawChannel`.
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
        self._common = setup.channel.count_numbers(per_peer=False)
        self._own = setup.channel.count_numbers(per_peer=True)

    def bind(self) -> None:
        """Compiles what `compute` calls, and looks up its types once for all."""
        a = self._arrays
        self._update = bind_leaf(update_law_view, 0, 0, a.site, a.links, a.chain)

    def compute(self, k: int, t_ns: int) -> list[float]:
        """Stage 6 of tick k: takes torque, estimate and what is sent in; returns the law's
        memory.

        Raises:
            LawFailed: it failed.
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
        """What the law remembers now."""
        return read_memory(self._law)

    def restore(self, memory: Sequence[float]) -> None:
        """Restores the law from its memory."""
        restore_law(self._law, self._setup.name, memory)

    def _read(self, k: int) -> LawInput:
        """Returns the input of tick k, after `update_law_view`."""
        setup = self._setup
        columns: list[Any] = [column.tolist() for column in self._of_peers]
        columns[4:] = [map(LawVector, rows) for rows in columns[4:]]  # q, qd, tau_x
        received = () if self._received is None else self._received.tolist()
        sent = self._sent.tolist()
        common = self._common
        own = self._own
        return LawInput(
            k=k,
            t_s=k / setup.rate_hz,
            h_s=1.0 / setup.rate_hz,
            joints=setup.layout.joints,
            coordinates=setup.layout.shared,
            peers=tuple(map(PeerView, *columns)),
            received=tuple(_name_vectors(self._receives, numbers) for numbers in received),
            sent=tuple(
                _name_vectors(self._sends[True], sent[common + j * own :])
                for j in range(len(columns[0]))
            ),
            to_all=_name_vectors(self._sends[False], sent),
            inertia=LawVector(map(LawVector, self._inertia.tolist())),
            **{name: LawVector(view.tolist()) for name, view in self._views.items()},
        )

    def _collect_sent(self, now: LawInput) -> list[float]:
        """Returns all that the law sends.

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
                        problem = (
                            f"has {count_nouns(len(values), 'number')}, not {vector.length}"
                        )
                        raise ValueError(f"{where}.{vector.name} {problem}")
                    sent += map(float, values)
        return sent
