"""Compiles a user's control law with Numba so that it runs as fast as the simulation kernel.

A control law is a class with a method `torque`, which computes the torque of an arm. The
compiled method returns bit-identical results to the Python method, so a law can be developed in
plain Python and compiled later.

Invariant:
    - The gains of a law are passed as a row of floats, so changing them does not require
      recompilation. A law is recompiled only for a different number of joints or peers, or for
      different vectors.
    - The kernel calls a law by address, so a new law does not require recompiling the kernel.
    - An index out of range and a division by zero raise the same exceptions as in plain Python.
"""

import dis
import hashlib
import re
from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numba
import numpy as np
from numba.core import types
from numba.core.errors import NumbaError
from numba.extending import register_jitable

from ...errors import LawFailed, ScenarioError, suggest_nearest
from ..links.link import ChannelArrays
from ..step.control import limit_torque
from ..step.jit import bind_leaf, compile_named, leaf
from ..step.site_arrays import SiteArrays
from ..step.site_setup import SiteSetup
from ..step.vectors import Array, Row, RowArray
from .law_channel import SentVector
from .law_view import PlainLaw, update_law_view
from .plugged import call_address, digest_sibling_sources, find_address
from .user_law import LawInput, LawResults, PeerView, SiteLaw

CHECKED: Any = {"_nrt": False, "boundscheck": True}
"""Compiler options for laws: invalid indices and divisions by zero raise exceptions."""
T = TypeVar("T")


def compiled(law: T) -> T:
    """Decorator that marks a control law, or a function that `torque` calls, for compilation.

    >>> @tn.compiled
    ... class Damper:
    ...     def __init__(self, facts):
    ...         pass
    ...     def torque(self, now):
    ...         for i in range(now.joints):
    ...             now.tau[i] = -now.qd[i]

    A class that keeps state between ticks must declare it in `remembers`. Code that Numba
    cannot compile is rejected when a site is built.
    """
    if not isinstance(law, type):
        # For a law in plain Python, the function stays a Python function, which accepts any
        # objects.
        function: Any = law
        callable_from_python: T = register_jitable(**CHECKED)(function)
        return callable_from_python
    law.is_compiled = True  # type: ignore[attr-defined]
    return cast(T, law)


def is_compiled(law: Any) -> bool:
    """Returns True if a user's control law is compiled to machine code before a run starts.

    The class of such a law is decorated with `compiled`. Returns False if Numba, the compiler,
    is disabled.
    """
    config: Any = numba.config
    return bool(getattr(law, "is_compiled", False)) and not config.DISABLE_JIT


@leaf
def _all_finite(values: Array) -> bool:
    """Returns True if all elements of an array are finite."""
    are_finite = True
    for i in range(values.shape[0]):
        are_finite = are_finite and np.isfinite(values[i])
    return are_finite


@leaf
def finish_law(s: Row, law: Array, sent: Array) -> None:
    """Checks the results of a user's control law, and limits its torque to the motors' range.

    Args:
        s: State of the site, with the torque and the estimate; the torque is limited.
        law: Memory of the law (the state that it keeps from tick to tick), followed by its
            gains. The memory is checked too.
        sent: Vectors that the law sends to other arms.

    Raises:
        FloatingPointError: A result is not finite.
    """
    is_torque_finite = _all_finite(s.tau[: s.joints])
    is_estimate_finite = _all_finite(s.theta_hat)
    is_sent_finite = _all_finite(sent)
    if not (is_torque_finite and is_estimate_finite and is_sent_finite):
        raise FloatingPointError
    if not _all_finite(law[: s.remembered]):
        raise FloatingPointError
    for i in range(s.joints):
        s.tau[i] = limit_torque(s.tau[i], s.tau_limit[i])


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
    """Computes the torque of an arm in one tick with a user's compiled law.

    The field `asked` of the site is 1 while the law runs, which shows whether an exception came
    from the law.

    Args:
        k: Number of the tick.
        t_ns: Nominal time of the tick, ns since the start of the session.
        address: Address of the law's machine code.
        law: Memory of the law (the state that it keeps from tick to tick) and its gains;
            modified.
        site: State of the site; the torque is written into it.
        links: State of each incoming link, one row per link.
        chain: Joint data, one row per joint. None for the planar two-link arm.
        channel: Vectors sent by the laws of the peers.
        sent: Receives the vectors that this law sends.

    Raises:
        FloatingPointError: A result is not finite.
    """
    update_law_view(k=k, t_ns=t_ns, site=site, links=links, chain=chain)
    s: Row = site[0]
    s.asked = 1
    call_address(address, (law, site, links, channel.received, sent))
    finish_law(s, law, sent)
    s.asked = 0


class LawForm(NamedTuple):
    """Data types, and the number of peers, for which a user's control law is compiled.

    Two laws of the same class with equal forms share the compiled code.

    Attributes:
        law: Names and shapes of the law's gains and memory.
        site: Data type of the state of the site.
        link: Data type of the state of an incoming link.
        received: Vectors that a peer sends. None if there are no such vectors.
        to_all: Vectors sent to all peers. None if there are no such vectors.
        sent: Vectors sent to a single peer. None if there are no such vectors.
        peers: Number of peers.
    """

    law: np.dtype[np.void]
    site: np.dtype[np.void]
    link: np.dtype[np.void]
    received: np.dtype[np.void] | None
    to_all: np.dtype[np.void] | None
    sent: np.dtype[np.void] | None
    peers: int


def _vectors_dtype(vectors: Sequence[SentVector], width: int = 0) -> np.dtype[np.void] | None:
    """Returns a NumPy dtype whose fields are named vectors, or None if there are no vectors.

    A compiled law uses it to access the vectors sent by other laws as fields, such as
    `received.F`.

    Args:
        vectors: The vectors, in the order in which the row contains them.
        width: Number of floats in the row, if it is longer than the vectors.
    """
    if not vectors:
        return None
    float_bytes = 8
    first = 0
    offsets = []
    for vector in vectors:
        offsets.append(float_bytes * first)
        first += vector.length
    layout: Any = {
        "names": [vector.name for vector in vectors],
        "formats": [("f8", (vector.length,)) for vector in vectors],
        "offsets": offsets,
        "itemsize": float_bytes * (width or first),
    }
    return np.dtype((np.record, layout))


# Numba cannot return a record from a function, so this function is inlined into its callers.
@numba.njit(inline="always", **CHECKED)  # type: ignore[untyped-decorator]
def collect_law_input(s: Row, links: Any, received: Any, sent: Any, to_all: Any) -> LawInput:
    """Collects the data that a compiled control law may read and write in one tick.

    The vectors are views of the simulation's arrays, which avoids copying in every tick.

    Args:
        s: State of the site.
        links: State of each link, one row per peer.
        received: Vectors received from each peer.
        sent: Vectors sent to individual peers.
        to_all: Vectors sent to all peers.
    """
    return LawInput(
        k=s.k,
        t_s=s.t_s,
        h_s=s.h_s,
        q=s.q,
        qd=s.qd,
        q_des=s.q_des,
        qd_des=s.qd_des,
        felt=s.felt,
        joints=s.joints,
        coordinates=s.shared,
        tau=s.tau,
        peers=links,
        received=received,
        sent=sent,
        to_all=to_all,
        tau_x=s.tau_x,
        tau_before=s.tau_before,
        q_before=s.q_before,
        gravity=s.G,
        theta_hat=s.theta_hat,
        inertia=s.M,
        bias=s.bias,
    )


@cache
def _compile_law(torque: Callable[..., Any], form: LawForm) -> Any:
    """Compiles the method `torque` of a control law to machine code.

    The arguments of the compiled function are arrays: the gains and memory of the law, the
    state of the site and of its links, and the vectors that the law receives and sends. Machine
    code for the laws of this package is cached on disk. User laws are compiled in each process.

    Args:
        torque: The method of the law's class.
        form: Data types of the arguments.

    Raises:
        NumbaError: The law cannot be compiled.
    """
    law_dtype = form.law
    received_dtype = form.received
    to_all_dtype = form.to_all
    sent_dtype = form.sent
    law_size = form.law.itemsize // 8
    to_all_size = 0 if to_all_dtype is None else to_all_dtype.itemsize // 8
    peer_size = 0 if sent_dtype is None else sent_dtype.itemsize // 8
    sent_end = to_all_size + form.peers * peer_size
    compute = numba.njit(**CHECKED)(torque)

    def call(law: Any, site: Any, links: Any, received: Any, sent: Any) -> None:
        """Collects the input of the control law, and calls the law's method `torque`.

        Nothing is copied: the law reads and writes the arrays of its site. The data are passed
        as arrays of floats. The law accesses them through views that have named fields and
        share the memory of these arrays.

        Args:
            law: Gains and memory of the law.
            site: State of the site, shape (1,).
            links: State of each link, one row per peer, in scenario order.
            received: Vectors received from each peer, one row per peer.
            sent: Vectors that this law sends: first those for all peers, then those for each
                peer.
        """
        s = site[0]
        # A layout is None if the vectors do not exist. Numba knows the layouts when it
        # compiles, and removes the branch whose type does not apply.
        from_peers = () if received_dtype is None else received.reshape(-1).view(received_dtype)
        to_peers = () if sent_dtype is None else sent[to_all_size:sent_end].view(sent_dtype)
        to_all = None if to_all_dtype is None else sent[:to_all_size].view(to_all_dtype)[0]
        now = collect_law_input(s, links, from_peers, to_peers, to_all)
        # `compute` is the compiled method, whose `self` is the record of the law's numbers.
        compute(law[:law_size].view(law_dtype)[0], now)

    numba_types: Any = numba
    site_type = numba_types.typeof(np.zeros(1, form.site))
    link_type = numba_types.typeof(np.zeros(1, form.link))
    floats = types.float64
    signature = types.none(floats[::1], site_type, link_type, floats[:, ::1], floats[::1])
    sources = digest_sibling_sources(torque)
    if sources:
        text = f"{sources} {torque.__module__} {torque.__qualname__} {form}"
        digest = hashlib.sha256(text.encode()).hexdigest()
        return compile_named(call, f"law_{digest[:32]}", signature, **CHECKED)
    function = numba.njit(signature, **CHECKED)(call)
    if any(known.return_type != types.none for known in compute.nopython_signatures):
        raise NumbaError(
            "torque returns a value, but a compiled law must write the torque to now.tau "
            "instead"
        )
    return function


def _read_numbers(law: Any, remembered: Sequence[str]) -> dict[str, np.ndarray[Any, Any]]:
    """Collects the gains and the memory of a law, which its compiled form stores in an array.

    These are the attributes of the instance, and those attributes of its class whose names
    occur in the method `torque`. Each of them needs a fixed type:

    - Integers that do not change, such as counts and indices, remain integers. Booleans that do
      not change become integers.
    - All other numbers become floats. They include integers that may change: the memory of the
      law, attributes assigned by `torque`, and elements of lists.

    Args:
        law: An instance of the law's class.
        remembered: Names of the attributes that the law keeps from tick to tick.

    Returns:
        A mapping from attribute name to array: first the memory, in the order of `remembered`,
            then the other attributes in alphabetical order. Attributes that are not numeric are
            omitted.
    """
    # The byte code of `torque` names the attributes that it reads and assigns. It does not tell
    # whether they belong to the law, so names of attributes of other objects are included.
    code = list(dis.get_instructions(type(law).torque))
    written = {step.argval for step in code if step.opname == "STORE_ATTR"}
    access = ("LOAD_ATTR", "LOAD_METHOD", "STORE_ATTR")
    used = {step.argval for step in code if step.opname in access}
    # Functions that `torque` calls may use any attribute of the instance.
    used |= vars(law).keys()

    others = sorted(name for name in used if hasattr(law, name))
    numbers_by_name = {}
    for name in dict.fromkeys([*remembered, *others]):
        value = getattr(law, name)
        try:
            numbers = np.asarray(value)
        except ValueError:  # a list of rows with different lengths
            continue
        kind = numbers.dtype.kind
        is_numeric = kind in "fiub"  # float, integer, unsigned integer or boolean
        if not is_numeric or not numbers.size:
            continue
        may_change = name in remembered or name in written or isinstance(value, list)
        dtype = np.float64 if may_change or kind == "f" else np.int64
        numbers_by_name[name] = numbers.astype(dtype)
    return numbers_by_name


_INPUTS = {
    "LawInput": ("now", LawInput._fields),
    "Record(alpha": ("an entry of now.peers", PeerView._fields),
}
"""Names and fields of the inputs of a law, keyed by the first words of their Numba types."""


def _explain(error: Exception, law: Any) -> str:
    """Explains to a user in one sentence why Numba cannot compile a control law.

    Numba's messages are long and refer to Numba types. Frequent causes are recognised and
    explained in terms of the law; otherwise the first sentence of the message is returned.

    Args:
        error: The error raised by Numba.
        law: An instance of the law's class.
    """
    text = re.sub(r"\x1b\[[0-9;]*m", "", str(error))
    file = re.escape(Path(type(law).torque.__code__.co_filename).name)
    line_numbers = re.findall(rf'{file}"?,? (?:line |\()(\d+)', text)
    location = f" (line {line_numbers[-1]})" if line_numbers else ""

    # Numba's message for code that allocates memory.
    if "NRT required" in text or "returning of array" in text:
        return (
            f"the law creates an array or a list{location}: compute number by number, as in "
            "now.tau[i] = -now.qd[i]; create lists in __init__, and let torque write into them"
        )
    field = re.search(r"Unknown attribute '(\w+)' of type (LawInput|Record\(alpha)", text)
    if field:
        return _explain_field(field[1], field[2], location)
    attribute = re.search(r"Unknown attribute '(\w+)' of type Record", text)
    if isinstance(error, KeyError):
        # Numba names the attribute, but not its object: the law itself or one of its peers.
        name = error.args[0]
        if _reads_own_attribute(law, name):
            return _explain_attribute(name, law, location)
        return _explain_field(name, "Record(alpha", location)
    if attribute:
        return _explain_attribute(attribute[1], law, location)
    global_name = re.search(r"Untyped global name '(\w+)'", text)
    if global_name:
        return (
            f"the law uses {global_name[1]}{location}, which is neither a number nor a "
            "function with @trilat_net.compiled"
        )

    lines = [line.strip() for line in text.splitlines() if line.strip()]
    noise = ("Failed in", "File", "During", "-", "^", "<", "[")
    sentences = [line for line in lines if not line.startswith(noise)]
    first_sentence = (sentences or lines)[0].rstrip(".:")
    return f"{first_sentence}{location}"


def _reads_own_attribute(law: Any, name: str) -> bool:
    """Returns True if the method `torque` of a law reads an attribute of the law itself.

    Numba's error names an unknown attribute, but not its object. The explanation for the user
    depends on whether the attribute belongs to `self` or to the law's input, which can be seen
    in the bytecode of the method.

    Args:
        law: An instance of the law's class.
        name: Name of the attribute.
    """
    instructions = list(dis.get_instructions(type(law).torque))
    self_name = type(law).torque.__code__.co_varnames[0]  # usually "self"
    # `self.NAME` is compiled to two instructions: load `self`, then read the attribute.
    return any(
        loading.argval == self_name and reading.argval == name
        for loading, reading in pairwise(instructions)
    )


def _explain_field(name: str, kind: str, location: str) -> str:
    """Explains to a user that the input of a control law has no field of a given name.

    The sentence suggests the field that was probably meant.

    Args:
        name: Name of the field.
        kind: The input, a key of `_INPUTS`.
        location: Line in the law's source, for example " (line 12)"; empty if unknown.
    """
    subject, names = _INPUTS[kind]
    nearest = suggest_nearest(name, names) or f"; it has {', '.join(names)}"
    return f"{subject} has no field {name}{location}{nearest}"


def _explain_attribute(name: str, law: Any, location: str) -> str:
    """Explains to a user why a compiled control law cannot use an attribute of `self`.

    Only numbers and lists of numbers can be compiled. The attribute has another type, does not
    exist, or is a method. For a method, the sentence suggests what to write instead.

    Args:
        name: Name of the attribute.
        law: An instance of the law's class.
        location: Line in the law's source, for example " (line 12)"; empty if unknown.
    """
    if not hasattr(law, name):
        problem = "does not exist"
    elif callable(getattr(law, name)):
        return (
            f"the law calls the method self.{name}{location}: use a function with "
            "@trilat_net.compiled instead"
        )
    else:
        kind = type(getattr(law, name)).__name__
        problem = f"is of type {kind}"
    return (
        f"self.{name} {problem}{location}, but must be a number, or a list of numbers of fixed "
        "length"
    )


class CompiledLaw:
    """A user's control law as machine code, with the arrays of the arm that it controls.

    Created by `plug_law`. `compute` is called once per tick.

    Args:
        law: An instance of the law's class.
        setup: Setup of the site.
        arrays: Arrays of the site. Their vectors may be longer than this site needs.
        sent: Part of the site's record for the vectors that the law sends. See `LawChannel`.

    Attributes:
        row: Memory of the law (the state that it keeps from tick to tick), followed by its
            gains.
        address: Address of the law's machine code.
        form: Layouts of the arrays of the law.
        torque: Method of the law's class that computes the torque, before compilation.

    Raises:
        ScenarioError: Numba cannot compile the law.
    """

    def __init__(self, law: Any, setup: SiteSetup, arrays: SiteArrays, sent: Array) -> None:
        path = f"sites.{setup.name}.control.law"
        site_law = SiteLaw(law, setup.name)
        remembered = site_law.remembered
        numbers = _read_numbers(law, remembered)
        missing = [name for name in remembered if name not in numbers]
        if missing:
            raise ScenarioError(
                f"{site_law.name}: the attribute {missing[0]}, which the law keeps from tick "
                "to tick, must be a number or a list of numbers",
                path=path,
            )

        channel = arrays.channel
        received_size = 0 if channel is None else channel.received.shape[-1]
        fields: Any = [(name, value.dtype, value.shape) for name, value in numbers.items()]
        self.torque: Callable[..., Any] = type(law).torque
        self.form = form = LawForm(
            law=np.dtype((np.record, fields or [("nothing", "f8")])),
            site=arrays.site.dtype,
            link=arrays.links.dtype,
            received=_vectors_dtype(setup.received_vectors, received_size),
            to_all=_vectors_dtype(setup.channel.select_vectors(per_peer=False)),
            sent=_vectors_dtype(setup.channel.select_vectors(per_peer=True)),
            peers=len(setup.links),
        )
        try:
            self._function = _compile_law(self.torque, form)
        except (NumbaError, KeyError) as error:
            raise ScenarioError(
                f"{site_law.name} cannot be compiled: {_explain(error, law)}", path=path
            ) from None

        self.address = find_address(self._function)
        row = np.zeros(1, form.law)
        for name, value in numbers.items():
            row[0][name] = value
        self.row: Array = row.view(np.float64)
        self._law = site_law
        self._arrays = arrays
        self._sent = sent
        self._stage = law_stage
        self._remembered = sum(numbers[name].size for name in remembered)
        arrays.site["remembered"] = self._remembered

    def bind(self) -> None:
        """Compiles `law_stage`, which calls the law, for the types of this site's arrays.

        The compilation takes seconds. Without this call, it would take place in the first tick.
        """
        arrays = self._arrays
        assert arrays.channel is not None
        # Only the types of the arguments matter, so tick and time may be any integers.
        example_tick = 0
        example_t_ns = 0
        self._stage = bind_leaf(
            law_stage,
            example_tick,
            example_t_ns,
            self.address,
            self.row,
            arrays.site,
            arrays.links,
            arrays.chain,
            arrays.channel,
            self._sent,
        )

    def compute(self, k: int, t_ns: int) -> list[float]:
        """Computes the torque of one tick with the compiled law.

        The torque and the vectors sent to other sites are written into the arrays of this site.

        Args:
            k: Number of the tick.
            t_ns: Nominal time of the tick, ns since the start of the session.

        Returns:
            The law's memory after the tick.

        Raises:
            LawFailed: The law raised an exception, or returned an invalid result.
        """
        arrays = self._arrays
        assert arrays.channel is not None
        try:
            # The arguments are positional, because compiled functions accept no keyword
            # arguments.
            self._stage(
                k,
                t_ns,
                self.address,
                self.row,
                arrays.site,
                arrays.links,
                arrays.chain,
                arrays.channel,
                self._sent,
            )
        except Exception as error:  # the user's code may raise any exception
            raise self.find_failure(error) or error from None
        return self.memory

    @property
    def memory(self) -> list[float]:
        """State vector that the control law keeps from this tick to the next.

        The vector is stored in the log, so that `restore` can later continue the run from this
        tick.
        """
        memory: list[float] = self.row[: self._remembered].tolist()
        return memory

    @property
    def memory_names(self) -> tuple[str, ...]:
        """Name of each entry of `memory`, for example "error[1]"."""
        return self._law.memory_names

    def restore(self, memory: Sequence[float]) -> None:
        """Restores the control law to its state after a recorded tick.

        Args:
            memory: State vector returned by `memory` after that tick.
        """
        self.row[: self._remembered] = memory

    def find_failure(self, error: Exception) -> LawFailed | None:
        """Describes how a user's control law failed, if the law raised the exception.

        Args:
            error: Exception raised while the torque of a tick was computed.

        Returns:
            An exception that names the law and the reason. None if the error originates in this
            program, since a bug of the program must not be blamed on the user's law.
        """
        s: Row = self._arrays.site[0]
        was_law_running = bool(s.asked)
        if not was_law_running:
            return None

        if isinstance(error, FloatingPointError):
            # A result was not finite: find out which one.
            results = LawResults(
                torque=s.tau.tolist(),
                theta_hat=s.theta_hat.tolist(),
                memory=self.memory,
                sent=self._sent.tolist(),
            )
            try:
                self._law.check_results(s.k, results)
            except LawFailed as failure:
                return failure
        return self._law.describe_failure(int(s.k), error)


def plug_law(
    law: Any, setup: SiteSetup, arrays: SiteArrays, sent: Array
) -> PlainLaw | CompiledLaw:
    """Connects a user's control law to a site, which can then compute torques with it.

    The law is compiled if its class is marked for compilation. Otherwise it runs as plain
    Python.

    Args:
        law: An instance of the law's class.
        setup: Setup of the site.
        arrays: Arrays of the site, which the law reads and writes.
        sent: Array for the values that the law sends to other sites. See `LawChannel`.

    Returns:
        The law, ready for use.

    Raises:
        ScenarioError: The law is marked for compilation, but Numba cannot compile it.
    """
    arrays.site["needs_model"] = getattr(law, "needs_model", False)
    arrays.site["holds"] = getattr(law, "holds", False)
    kind = CompiledLaw if is_compiled(law) else PlainLaw
    return kind(law, setup, arrays, sent)
