"""Provides the input of a control law in each tick: the motion of its own and the other arms.

The compiled control loop stores the state of an arm in rows of arrays, which a compiled control
law reads directly. For a law in plain Python, this module copies the rows to lists and writes
the results of the law back.

Invariant:
    - A law receives the same values whether it is compiled or runs in plain Python.
    - A vector that the law sends to other arms keeps its values until the law overwrites it.
"""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from ...errors import count_nouns
from ..arms import chain_stages, two_link_stages
from ..step.jit import bind_leaf, leaf
from ..step.site_arrays import SiteArrays
from ..step.site_setup import SiteSetup
from ..step.ticks import tick_ns
from ..step.vectors import Array, Row, RowArray
from .law_channel import SentVector
from .user_law import LawInput, LawVector, PeerView, SiteLaw, UserLaw


@leaf
def _update_model(s: Row, chain: RowArray | None) -> None:
    """Computes the gravity torque, inertia matrix and bias torque of an arm for a user's law.

    The bias torque is the torque due to Coriolis forces, gravity and friction, which is
    required even without acceleration.

    Args:
        s: State of the site.
        chain: Joint data, one row per joint. None for the planar two-link arm.
    """
    if chain is None:
        two_link_stages.update_model(s)
    else:
        chain_stages.update_model(s, chain)


@leaf
def update_law_view(
    k: int, t_ns: int, site: RowArray, links: RowArray, chain: RowArray | None
) -> None:
    """Prepares the input of a user's control law: time, arm model and ages of the samples.

    The rest of the input is already in place. The torque is set to NaN, so that the caller can
    tell whether the law has written a torque.

    Args:
        k: Number of the tick.
        t_ns: Nominal time of the tick, ns since the start of the session.
        site: State of the site, shape (1,); modified.
        links: States of the links from the other sites, one row per link; modified.
        chain: Joint data, one row per joint. None for the planar two-link arm.
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
        stamp_ns = tick_ns(max(link.used, 0), link.rate_hz)
        link.age_s = (t_ns - stamp_ns) * 1e-9


_PER_JOINT = ("q", "qd", "tau_x", "tau_before", "q_before", "tau", "gravity", "bias")
_PER_COORDINATE = ("q_des", "qd_des", "felt")
_IN_ROW = {"gravity": "G"}
"""Mapping from field names of a law's input to those of the site's row, where they differ."""
_FIRST_PEER_VECTOR = PeerView._fields.index("q")
"""Index of the first vector in `PeerView`: q, qd and tau_x follow the scalar fields."""


def _name_vectors(vectors: Sequence[SentVector], numbers: list[float]) -> SimpleNamespace:
    """Splits a list of numbers into named vectors, which a control law reads as attributes.

    For example, a received vector F is read as `received.F`.

    Args:
        vectors: Names and lengths of the vectors.
        numbers: Concatenated values of the vectors. Any further values are ignored.
    """
    named = SimpleNamespace()
    first = 0
    for vector in vectors:
        end = first + vector.length
        setattr(named, vector.name, LawVector(numbers[first:end]))
        first = end
    return named


class PlainLaw:
    """A user's control law in plain Python, with the arrays of the arm that it controls.

    In each tick, the law receives lists of numbers, and its results are written into the
    arrays.

    Args:
        law: The law.
        setup: Setup of the site.
        arrays: Arrays of the site. Their vectors may be longer than this site needs.
        sent: Part of the site's record for the vectors that the law sends. See `LawChannel`.
    """

    def __init__(self, law: UserLaw, setup: SiteSetup, arrays: SiteArrays, sent: Array) -> None:
        channel = setup.channel
        layout = setup.layout
        joints = layout.joints
        shared = layout.shared
        self._law = SiteLaw(law, setup.name)
        self._setup = setup
        self._arrays = arrays
        self._sent = sent
        self._update = update_law_view

        # Views of the arrays: reading them yields the current state of the site, and writing
        # into them changes it.
        site = arrays.site[0]
        self._views: dict[str, Array] = {}
        for name in _PER_JOINT:
            field = _IN_ROW.get(name, name)
            self._views[name] = site[field][:joints]
        for name in _PER_COORDINATE:
            self._views[name] = site[name][:shared]
        self._views["theta_hat"] = site["theta_hat"][: layout.parameters]
        self._inertia = site["M"][:joints, :joints]
        self._limit = site["tau_limit"][:joints]

        self._peer_columns: list[Any] = []
        for name in PeerView._fields:
            column = arrays.links[name]
            is_vector = column.ndim > 1
            self._peer_columns.append(column[:, :shared] if is_vector else column)

        self._received = None if arrays.channel is None else arrays.channel.received
        self._receives = setup.received_vectors
        self._sends_to_all = channel.select_vectors(per_peer=False)
        self._sends_to_peer = channel.select_vectors(per_peer=True)
        self._to_all_size = channel.count_numbers(per_peer=False)
        self._peer_size = channel.count_numbers(per_peer=True)

    def bind(self) -> None:
        """Compiles the function that collects the input of the control law.

        Without this call, the compilation would take place in the first tick.
        """
        a = self._arrays
        self._update = bind_leaf(update_law_view, 0, 0, a.site, a.links, a.chain)

    def compute(self, k: int, t_ns: int) -> list[float]:
        """Computes the torque of one tick with the user's law.

        The torque, the parameter estimate and the vectors for other sites are written into the
        arrays of this site.

        Args:
            k: Number of the tick.
            t_ns: Nominal time of the tick, ns since the start of the session.

        Returns:
            The law's memory after the tick.

        Raises:
            LawFailed: The law raised an exception, or returned an invalid result.
        """
        arrays = self._arrays
        # Write the input of the law into the arrays, and read it from there as lists.
        self._update(k, t_ns, arrays.site, arrays.links, arrays.chain)
        law_input = self._read(k)
        results = self._law.call(law_input, self._collect_sent)

        # `SiteLaw.call` has checked that the results are finite and of the right length.
        limit = self._limit
        self._views["tau"][:] = np.clip(results.torque, -limit, limit)
        self._views["theta_hat"][:] = results.theta_hat
        self._sent[:] = results.sent
        return results.memory

    @property
    def memory(self) -> list[float]:
        """State vector that the law keeps from this tick to the next.

        The vector is stored with the results of each tick, so that `restore` can later continue
        the run from this tick.
        """
        return self._law.memory

    @property
    def memory_names(self) -> tuple[str, ...]:
        """Name of each entry of `memory`, for example "error[1]"."""
        return self._law.memory_names

    def restore(self, memory: Sequence[float]) -> None:
        """Restores the control law to its state after a recorded tick.

        Args:
            memory: State vector returned by `memory` after that tick.
        """
        self._law.restore(memory)

    def _read(self, k: int) -> LawInput:
        """Collects the input of the control law for one tick.

        `update_law_view` must have been called before. All values are copied from the arrays to
        lists, which plain Python reads faster.

        The input also contains the vectors that the law sends to its peers, with their values
        from the previous tick. The law overwrites them, and `_collect_sent` reads the new
        values. The array is ordered like a record: first the vectors sent to all peers, then
        the vectors sent to each single peer.

        Args:
            k: Number of the tick.
        """
        setup = self._setup
        # One column per field of `PeerView`, in their order, with one entry per peer.
        columns: list[Any] = [column.tolist() for column in self._peer_columns]
        vector_columns = columns[_FIRST_PEER_VECTOR:]
        columns[_FIRST_PEER_VECTOR:] = [map(LawVector, rows) for rows in vector_columns]
        peers = tuple(map(PeerView, *columns))

        received = [] if self._received is None else self._received.tolist()
        from_peers = [_name_vectors(self._receives, numbers) for numbers in received]

        sent = self._sent.tolist()
        to_peers = []
        for j in range(len(peers)):
            first_to_peer = self._to_all_size + j * self._peer_size
            to_peers.append(_name_vectors(self._sends_to_peer, sent[first_to_peer:]))

        vectors = {}
        for name, view in self._views.items():
            vectors[name] = LawVector(view.tolist())
        return LawInput(
            k=k,
            t_s=k / setup.rate_hz,
            h_s=1.0 / setup.rate_hz,
            joints=setup.layout.joints,
            coordinates=setup.layout.shared,
            peers=peers,
            received=tuple(from_peers),
            sent=tuple(to_peers),
            to_all=_name_vectors(self._sends_to_all, sent),
            inertia=LawVector(map(LawVector, self._inertia.tolist())),
            **vectors,
        )

    def _collect_sent(self, now: LawInput) -> list[float]:
        """Returns all values that the law sends to other arms, in log order.

        Args:
            now: Input of the tick, which contains the vectors written by the law.

        Raises:
            ValueError: The length of a vector differs from its declaration.
        """
        sent = _collect_vectors(self._sends_to_all, now.to_all, "to_all")
        for j, to_peer in enumerate(now.sent):
            sent += _collect_vectors(self._sends_to_peer, to_peer, f"sent[{j}]")
        return sent


def _collect_vectors(declared: Sequence[SentVector], vectors: Any, name: str) -> list[float]:
    """Returns the vectors that a control law sends as one flat list.

    The order and the lengths follow the law's declaration.

    Args:
        declared: Vectors that the law declares.
        vectors: Values of the vectors, as attributes.
        name: Name of `vectors` in the law's input, for error messages.

    Raises:
        ValueError: The length of a vector differs from its declaration.
    """
    numbers: list[float] = []
    for vector in declared:
        values = list(getattr(vectors, vector.name))
        if len(values) != vector.length:
            required = count_nouns(vector.length, "number")
            raise ValueError(
                f"{name}.{vector.name} must have {required}, but has {len(values)}"
            )
        numbers += map(float, values)
    return numbers
