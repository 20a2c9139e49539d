# mypy: disallow-untyped-calls=False, disallow-untyped-decorators=False
# mypy: disable-error-code="no-any-return"
"""Compiles control laws into the simulation of several runs at once.

Laws such as `tdpa`, and those that users write, are classes with a method `torque`. A single
run calls the compiled method by its address. For several runs, with one run per lane of the
vector registers, the method is compiled into the control period instead. This saves the call,
and also the checks of the vector lengths, which are constants in this case.

Invariant:
    - The method is not changed. It raises the same errors, and reads and writes the same
      values, as in a run that is computed alone.
    - A user's law is compiled in every process, because the other files that it uses are
      unknown. The code of a built-in law is stored under a hash of its sources.
"""

import hashlib
from collections.abc import Callable
from functools import cache
from itertools import count
from typing import Any, NamedTuple

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.extending import intrinsic, models, register_jitable, register_model

from ...records import Mode
from ..plug.compiled_law import CHECKED, CompiledLaw, LawForm, collect_law_input, finish_law
from ..plug.law_view import update_law_view
from ..plug.plugged import digest_sibling_sources
from ..step.jit import leaf, set_lane_form
from ..step.vectors import RowArray
from .lane_rows import Constants, LaneTable, RowsInLane, offset_rows

_DIVERGED = int(Mode.DIVERGED)
NO_LAW = "none"
"""Law name of a site whose law is part of the kernel."""


class LaneLaw(NamedTuple):
    """Properties of a control law on which the compiled code of a simulation depends.

    Runs share the code if these properties are equal.

    Attributes:
        name: Identifies the code of the law. `NO_LAW` if the law is part of the module
            `kernel`.
        is_stored: True if the compiled code may be stored on disk.
        size: Number of gains and memory values of the law.
        constants: Names and values of the flags among the gains and memory values. Flags are
            integers equal to 0 or 1 that never change and are equal in all runs.
        columns: For each peer, the indices of the values that the law receives among the values
            that the peer sends, or -1 for a value that the peer does not send.
    """

    name: str
    is_stored: bool
    size: int
    constants: Constants
    columns: tuple[tuple[int, ...], ...]

    @classmethod
    def describe(cls, law: CompiledLaw | None, columns: Any) -> "LaneLaw":
        """Returns the properties of a control law on which the code of a simulation depends.

        The same code can simulate several runs side by side only if these properties are equal.

        Args:
            law: The law, or None if the site's law is part of the kernel.
            columns: Indices of the C values that the law receives from each of P peers, shape
                (P, C).
        """
        if law is None:
            return cls(NO_LAW, is_stored=True, size=0, constants=(), columns=())
        form = law.form
        name, is_stored = _name_law(law.torque, form)
        size = form.law.itemsize // 8
        row = law.row[:size].view(form.law)[0]
        constants = []
        for field, (dtype, *_) in (form.law.fields or {}).items():
            # Other integers are not constants, because a study may vary them for one structure.
            if dtype.kind == "i" and not dtype.shape and row[field] in (0, 1):
                constants.append((field, int(row[field])))
        return cls(
            name=name,
            is_stored=is_stored,
            size=size,
            constants=tuple(constants),
            columns=tuple(tuple(peer) for peer in columns.tolist()),
        )


class _LawMethod(NamedTuple):
    """Method `torque` of a control law, and the data types of its arrays."""

    torque: Callable[..., Any]
    form: LawForm


_METHODS: dict[str, _LawMethod] = {}
"""Methods of laws, keyed by the name of the law."""
_user_law_numbers = count()


@cache
def _name_law(torque: Callable[..., Any], form: LawForm) -> tuple[str, bool]:
    """Returns a name that identifies the code of a law, and whether it may be stored on disk.

    Compiled code is stored under this name. User code is not stored, because it may use other
    files, and changes to these would go unnoticed.
    """
    sources = digest_sibling_sources(torque)
    text = f"{sources} {torque.__module__} {torque.__qualname__} {form}"
    name = hashlib.sha256(text.encode()).hexdigest()[:32]
    if not sources:
        name = f"user{next(_user_law_numbers)}"
    _METHODS[name] = _LawMethod(torque, form)
    return name, bool(sources)


class LawCode(types.Type):
    """Numba type of an argument that tells the compiler which control law to call.

    The argument has no value at run time. The code is selected by its type alone.

    Args:
        law: The law.
    """

    in_lanes = True

    def __init__(self, law: LaneLaw) -> None:
        self.law_name = law.name
        self.constants = law.constants
        self.is_stored = law.is_stored
        super().__init__(f"LawCode({law.name}, {law.constants})")

    @property
    def mangling_args(self) -> tuple[str, tuple[str]]:
        """Form of this type that Numba uses in the names of compiled functions."""
        digest = hashlib.sha256(self.name.encode()).hexdigest()
        return "LawCode", (f"c{digest[:16]}",)


@register_model(LawCode)
class _CodeModel(models.PrimitiveModel):
    """Represents a `LawCode` in machine code as an unused pointer."""

    def __init__(self, manager: Any, numba_type: Any) -> None:
        super().__init__(manager, numba_type, ir.IntType(8).as_pointer())


def _make_view(
    dtype: np.dtype[Any] | None, rows: int, first_word: int, constants: Constants = ()
) -> Any:
    """Returns a compiled function that views an unstructured vector as named fields.

    A control law declares the names of its gains and of the values that it sends, while the
    arrays of the simulation store them without names. The function converts nothing; it only
    views the same memory as another type.

    Args:
        dtype: Names and types of the fields. None if there are no such values.
        rows: Number of rows, each of which has these fields.
        first_word: Index of the value at which the first row starts.
        constants: Names and values of fields that are equal in all runs.
    """
    if dtype is None:
        return _no_rows
    row_type = LaneTable(dtype, (constants,) * rows)

    @intrinsic
    def view(_context: Any, numbers: Any) -> Any:
        rows_type = RowsInLane(row_type, row_type.constants)

        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            source = cgutils.create_struct_proxy(sig.args[0])(context, builder, value=args[0])
            target = cgutils.create_struct_proxy(rows_type)(context, builder)
            target.pointer = offset_rows(builder, source.pointer, first_word)
            target.lane = source.lane
            return target._getvalue()

        return rows_type(numbers), generate

    return view


@register_jitable
def _no_rows(_numbers: Any) -> tuple[()]:
    """Returns an empty tuple, in place of vectors that a law does not exchange."""
    return ()


@register_jitable
def _first_row(rows: Any) -> Any:
    """Returns the first row, which is the only one."""
    return rows[0]


@register_jitable
def _no_row(_rows: Any) -> None:
    """Returns None, in place of a row that does not exist."""


@leaf
def compute_law(
    code: Any,
    k: int,
    t_ns: int,
    site: RowArray,
    links: RowArray,
    chain: RowArray | None,
    law: RowArray,
    received: RowArray,
    sent: RowArray,
) -> None:
    """Computes the torque of a compiled control law in one tick, for one of several runs.

    Does nothing if the site's law is part of the kernel, which computes such laws itself. The
    function body is only a placeholder: the compiler replaces it with the version of the law
    selected by the type of `code` (`_choose_law`).

    Args:
        code: Tells the compiler which law to call.
        k: Current tick.
        t_ns: Nominal time of the tick, ns since the epoch.
        site: Row of the site, to which the torque is written.
        links: Rows of the site's links.
        chain: Rows of the chain of joints, or None for the planar arm. The row of the site
            already contains the chain's model.
        law: Row with the gains and memory of the law; updated in place.
        received: Rows with the values sent by the peers' laws.
        sent: Row with the values sent by this law; updated in place.

    Raises:
        FloatingPointError: A result is not finite.
    """
    raise NotImplementedError  # each law has its own version, see `set_lane_form`


def _compute_nothing(
    _code: Any,
    _k: int,
    _t_ns: int,
    _site: Any,
    _links: Any,
    _chain: Any,
    _law: Any,
    _received: Any,
    _sent: Any,
) -> None:
    """Does nothing. This is the version of `compute_law` for laws of the kernel."""


def _choose_law(argument_types: tuple[Any, ...]) -> Callable[..., None]:
    """Returns the version of `compute_law` that calls the control law of a site.

    The compiler calls this function with the argument types, the first of which identifies the
    law.
    """
    code = argument_types[0]
    if code.law_name == NO_LAW:
        return _compute_nothing
    method = _METHODS[code.law_name]
    form = method.form
    to_all_size = 0 if form.to_all is None else form.to_all.itemsize // 8
    compute = numba.njit(**CHECKED)(method.torque)
    view_law = _make_view(form.law, 1, 0, code.constants)
    view_received = _make_view(form.received, form.peers, 0)
    view_to_all = _make_view(form.to_all, 1, 0)
    view_sent = _make_view(form.sent, form.peers, to_all_size)
    choose_row = _no_row if form.to_all is None else _first_row

    def compute_torque(
        _code: Any,
        k: int,
        t_ns: int,
        site: Any,
        links: Any,
        chain: Any,
        law: Any,
        received: Any,
        sent: Any,
    ) -> None:
        """Calls the control law of this site, with the arguments of `compute_law`.

        The law is selected at compile time by the type of the first argument, which has no
        value of its own.
        """
        s = site[0]
        if s.mode == _DIVERGED:
            return
        update_law_view(k, t_ns, site, links, chain)
        now = collect_law_input(
            s,
            links,
            view_received(received),
            view_sent(sent),
            choose_row(view_to_all(sent)),
        )
        compute(view_law(law)[0], now)
        finish_law(s, law[0].numbers, sent[0].numbers[: s.sent])

    return compute_torque


set_lane_form(compute_law, _choose_law)
