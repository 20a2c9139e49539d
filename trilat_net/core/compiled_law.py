"""A control law whose `torque` is compiled: the same class, the same bits, the speed of the
kernel.

Invariant: a law is compiled for the layout of its rows alone; its numbers stand in a row of
floats, and the kernel calls it by its address, so that no law recompiles the kernel. An index
out of range and a division by zero raise as they do in plain Python.
"""

import dis
import hashlib
import re
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numba
import numpy as np
from numba.core import types
from numba.core.errors import NumbaError

from ..errors import LawFailed, ScenarioError
from .control import limit_torque
from .jit import bind_leaf, compile_named, leaf
from .law_channel import SentVector
from .law_view import PlainLaw, update_law_view
from .link import ChannelArrays
from .plugged import call_address, digest_sibling_sources, find_address
from .site_arrays import SiteArrays
from .site_setup import SiteSetup
from .user_law import (
    LawInput,
    LawResults,
    check_results,
    describe_failure,
    law_name,
    list_remembered,
)
from .vectors import Array, Row, RowArray

_CHECKED: Any = {"_nrt": False, "boundscheck": True}
T = TypeVar("T")


def compiled(law: T) -> T:
    """Has the `torque` of a control law compiled, or a function that it calls; for use as a
    decorator.

    >>> @tn.compiled
    ... class Damper:
    ...     def __init__(self, facts):
    ...         pass
    ...     def torque(self, now):
    ...         for i in range(now.joints):
    ...             now.tau[i] = -now.qd[i]

    A class with memory needs `remembers`. What Numba does not take is refused when a site is
    built.
    """
    if not isinstance(law, type):
        return cast(T, numba.njit(**_CHECKED)(law))
    law.is_compiled = True  # type: ignore[attr-defined]
    return cast(T, law)


def is_compiled(law: Any) -> bool:
    """True if the `torque` of a law is to be compiled; without a compiler it runs as it is."""
    config: Any = numba.config
    return bool(getattr(law, "is_compiled", False)) and not config.DISABLE_JIT


@leaf
def _all_finite(values: Array) -> bool:
    finite = True
    for i in range(values.shape[0]):
        finite = finite and np.isfinite(values[i])
    return finite


@leaf
def law_stage(
    k: int,
    t_ns: int,
    address: int,
    law: Array,
    site: RowArray,
    links: RowArray,
    chain: RowArray | None,
    channel: ChannelArrays,
    sent: Array,
) -> None:
    """Stage 6 of a compiled law, whose numbers are `law`; while it is `asked`, what is raised
    is its own.
    """
    update_law_view(k=k, t_ns=t_ns, site=site, links=links, chain=chain)
    s: Row = site[0]
    s.asked = 1
    call_address(address, (law, site, links, channel.received, sent))
    if not (_all_finite(s.tau[: s.joints]) and _all_finite(s.theta_hat) and _all_finite(sent)):
        raise FloatingPointError
    if not _all_finite(law[: s.remembered]):
        raise FloatingPointError
    for i in range(s.joints):
        s.tau[i] = limit_torque(s.tau[i], s.tau_limit[i])
    s.asked = 0


class _Form(NamedTuple):
    """The layouts for which a law is compiled.

    Attributes:
        law: of its numbers.
        site: of its site's row.
        link: of its links' rows.
        received: of what a peer sends; None: nothing.
        to_all: of what it sends to all; None: nothing.
        sent: of what it sends to one peer; None: nothing.
        peers: how many there are.
    """

    law: np.dtype[np.void]
    site: np.dtype[np.void]
    link: np.dtype[np.void]
    received: np.dtype[np.void] | None
    to_all: np.dtype[np.void] | None
    sent: np.dtype[np.void] | None
    peers: int


def _vectors_dtype(vectors: Sequence[SentVector], width: int = 0) -> np.dtype[np.void] | None:
    """Returns the layout of some vectors, of `width` numbers if more of them stand in an
    array's row.
    """
    if not vectors:
        return None
    lengths = [vector.length for vector in vectors]
    table: Any = {
        "names": [vector.name for vector in vectors],
        "formats": [("f8", (length,)) for length in lengths],
        "offsets": [8 * sum(lengths[:n]) for n in range(len(lengths))],
        "itemsize": 8 * (width or sum(lengths)),
    }
    return np.dtype((np.record, table))


@cache
def _compile_law(torque: Callable[..., Any], form: _Form) -> Any:
    """Returns a compiled function of the law's numbers, the site, its links, what came and what
    is sent.
    """
    law_dtype = form.law
    received_dtype = form.received
    to_all_dtype = form.to_all
    sent_dtype = form.sent
    numbers = form.law.itemsize // 8
    peers = form.peers
    common = 0 if to_all_dtype is None else to_all_dtype.itemsize // 8
    own = 0 if sent_dtype is None else sent_dtype.itemsize // 8
    compute = numba.njit(**_CHECKED)(torque)

    def call(law: Any, site: Any, links: Any, received: Any, sent: Any) -> None:
        s = site[0]
        got = () if received_dtype is None else received.reshape(-1).view(received_dtype)
        each = (
            () if sent_dtype is None else sent[common : common + peers * own].view(sent_dtype)
        )
        every = None if to_all_dtype is None else sent[:common].view(to_all_dtype)[0]
        first = (
            s.k,
            s.t_s,
            s.h_s,
            s.q,
            s.qd,
            s.q_des,
            s.qd_des,
            s.felt,
            s.joints,
            s.shared,
            s.tau,
        )
        last = (s.tau_x, s.tau_before, s.q_before, s.G, s.theta_hat, s.M, s.bias)
        now = LawInput(*first, links, got, each, every, *last)
        compute(law[:numbers].view(law_dtype)[0], now)

    kinds: Any = numba
    rows = [kinds.typeof(np.zeros(1, dtype)) for dtype in (form.site, form.link)]
    floats = types.float64
    signature = types.none(floats[::1], *rows, floats[:, ::1], floats[::1])
    if made_of := digest_sibling_sources(torque):
        name = hashlib.sha256(
            f"{made_of} {torque.__module__} {torque.__qualname__} {form}".encode()
        )
        return compile_named(call, f"law_{name.hexdigest()[:32]}", signature, **_CHECKED)
    called = numba.njit(signature, **_CHECKED)(call)
    if any(known.return_type != types.none for known in compute.nopython_signatures):
        raise NumbaError("torque returns something: compiled, it writes now.tau instead")
    return called


def _read_numbers(law: Any) -> dict[str, np.ndarray[Any, Any]]:
    """Returns the attributes of a law that are numbers: what it remembers, then the others.

    A number that `torque` writes, and a list, is of floats; other integers stay integers.
    """
    code = list(dis.get_instructions(type(law).torque))
    written = {one.argval for one in code if one.opname == "STORE_ATTR"}
    named = {
        one.argval for one in code if one.opname in ("LOAD_ATTR", "LOAD_METHOD", "STORE_ATTR")
    }
    named |= vars(law).keys()  # which functions that `torque` calls may name
    found = {}
    for name in dict.fromkeys(
        [*list_remembered(law), *sorted(filter(lambda one: hasattr(law, one), named))]
    ):
        value = getattr(law, name)
        try:
            numbers = np.asarray(value)
        except ValueError:  # rows of several lengths
            continue
        if numbers.dtype.kind not in "fiub" or not numbers.size:
            continue
        changes = name in list_remembered(law) or name in written or isinstance(value, list)
        found[name] = numbers.astype(
            np.float64 if changes or numbers.dtype.kind == "f" else np.int64
        )
    return found


def _explain(error: Exception, law: Any) -> str:
    """Returns what Numba does not take of a law, in a sentence."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", str(error))
    file = re.escape(Path(type(law).torque.__code__.co_filename).name)
    lines = re.findall(rf'{file}"?,? (?:line |\()(\d+)', text)
    where = f" (line {lines[-1]})" if lines else ""
    if "NRT required" in text or "returning of array" in text:
        how = "arithmetic goes number by number, as in now.tau[i] = -now.qd[i]; a list is made in __init__"
        return f"it makes an array or a list{where}: {how}, and written into here"
    found = re.search(r"Unknown attribute '(\w+)' of type Record", text)
    if name := error.args[0] if isinstance(error, KeyError) else found and found[1]:
        if hasattr(law, name) and callable(getattr(law, name)):
            return (
                f"it calls its method {name}{where}: use a function with @trilat_net.compiled"
            )
        kind = (
            f"a {type(getattr(law, name)).__name__}"
            if hasattr(law, name)
            else "no attribute of it"
        )
        return f"self.{name} is {kind}{where}: a number, or a list of numbers of fixed length, is taken"
    if found := re.search(r"Untyped global name '(\w+)'", text):
        return f"it uses {found[1]}{where}, which is neither a number nor a function with @trilat_net.compiled"
    plain = [line.strip() for line in text.splitlines() if line.strip()]
    told = [
        line
        for line in plain
        if not line.startswith(("Failed in", "File", "During", "-", "^", "<", "["))
    ]
    return f"{(told or plain)[0].rstrip('.:')}{where}"


class CompiledLaw:
    """A compiled law at its site.

    Args:
        law: the law as it was made.
        setup: of its site.
        arrays: of its site; its vectors may be longer than the site's.
        sent: what its record names as sent, see `LawChannel`.

    Attributes:
        row: its numbers, what it remembers first.
        address: of its machine code.

    Raises:
        ScenarioError: Numba does not take it.
    """

    def __init__(self, law: Any, setup: SiteSetup, arrays: SiteArrays, sent: Array) -> None:
        path = f"sites.{setup.name}.control.law"
        numbers = _read_numbers(law)
        received = 0 if arrays.channel is None else arrays.channel.received.shape[-1]
        if missing := [name for name in list_remembered(law) if name not in numbers]:
            problem = (
                f"{missing[0]}, which it remembers, is neither a number nor a list of numbers"
            )
            raise ScenarioError(f"{law_name(law)}: {problem}", path=path)
        fields: Any = [(name, value.dtype, value.shape) for name, value in numbers.items()]
        form = _Form(
            law=np.dtype((np.record, fields or [("nothing", "f8")])),
            site=arrays.site.dtype,
            link=arrays.links.dtype,
            received=_vectors_dtype(setup.received_vectors, received),
            to_all=_vectors_dtype(setup.channel.select_vectors(per_peer=False)),
            sent=_vectors_dtype(setup.channel.select_vectors(per_peer=True)),
            peers=len(setup.links),
        )
        try:
            self._function = _compile_law(type(law).torque, form)
        except (NumbaError, KeyError) as error:
            raise ScenarioError(
                f"{law_name(law)} cannot be compiled: {_explain(error, law)}", path=path
            ) from None
        self.address = find_address(self._function)
        whole = np.zeros(1, form.law)
        for name, value in numbers.items():
            whole[0][name] = value
        self.row: Array = whole.view(np.float64)
        self._law = law
        self._name = setup.name
        self._arrays = arrays
        self._sent = sent
        self._stage = law_stage
        self._remembered = sum(numbers[name].size for name in list_remembered(law))
        arrays.site["remembered"] = self._remembered

    def bind(self) -> None:
        """Compiles what `compute` calls, and looks up its types once for all."""
        a = self._arrays
        assert a.channel is not None
        rows = (self.row, a.site, a.links, a.chain, a.channel, self._sent)
        self._stage = bind_leaf(law_stage, 0, 0, self.address, *rows)

    def compute(self, k: int, t_ns: int) -> list[float]:
        """Stage 6 of tick k, see `law_stage`; returns the law's memory.

        Raises:
            LawFailed: it failed.
        """
        a = self._arrays
        assert a.channel is not None
        try:
            self._stage(
                k, t_ns, self.address, self.row, a.site, a.links, a.chain, a.channel, self._sent
            )
        except Exception as error:  # whatever the law raises
            raise self.find_failure(error) or error from None
        return self.memory

    @property
    def memory(self) -> list[float]:
        """What the law remembers now."""
        memory: list[float] = self.row[: self._remembered].tolist()
        return memory

    def restore(self, memory: Sequence[float]) -> None:
        """Restores the law from its memory."""
        self.row[: self._remembered] = memory

    def find_failure(self, error: Exception) -> LawFailed | None:
        """Returns the failure of this law that made its machine code raise; None: it was not
        asked.
        """
        s: Row = self._arrays.site[0]
        if not s.asked:
            return None
        if isinstance(error, FloatingPointError):
            numbers = (s.tau, s.theta_hat, self.row[: self._remembered], self._sent)
            try:
                check_results(
                    self._law, self._name, s.k, LawResults(*(one.tolist() for one in numbers))
                )
            except LawFailed as failed:
                return failed
        return describe_failure(self._law, self._name, int(s.k), error)


def plug_law(
    law: Any, setup: SiteSetup, arrays: SiteArrays, sent: Array
) -> PlainLaw | CompiledLaw:
    """Returns a law at its site, ready to be asked, see `PlainLaw`.

    Raises:
        ScenarioError: it is to be compiled, and Numba does not take it.
    """
    arrays.site["needs_model"] = getattr(law, "needs_model", False)
    arrays.site["holds"] = getattr(law, "holds", False)
    return (CompiledLaw if is_compiled(law) else PlainLaw)(law, setup, arrays, sent)
