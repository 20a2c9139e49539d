# mypy: disallow-untyped-calls=False, disable-error-code="no-any-return"
"""The one typed wrapper around Numba.

Invariants: a leaf is compiled for float64 without reordering (no fastmath), so compiled and
plain Python runs give the same bits. Machine code is cached in the user's cache directory, in a
folder named after a hash of all sources of the core: Numba alone notices a change of the file
that holds a leaf, not of the leaves it calls. A wheel brings such a folder with code for the
generic processor of its platform, which is used where the user's has none for this processor.
Nobody else's code is compiled or looked for otherwise.
"""

import hashlib
import os
import pickle
import sys
import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ParamSpec, TypeVar, cast

import numba
from llvmlite.binding import parse_bitcode
from numba.core import event, types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, compile_result
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature

from ..process import end_process_at_signals

P = ParamSpec("P")
R = TypeVar("R")

with suppress(OSError, IndexError):  # of Linux alone
    _addresses = (
        Path("/proc/self/limits")
        .read_text("utf-8")
        .partition("Max address space")[2]
        .split()[0]
    )
    if _addresses != "unlimited" and int(_addresses) < 1 << 30:
        raise MemoryError  # LLVM and OpenBLAS would try for ever, deaf to signals, or abort


def _cache_root() -> Path:
    """Returns the user's cache directory by the custom of each platform."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))


def _core_digest() -> str:
    """Returns a hash of every source file of the core and of Numba's version."""
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _writable_cache() -> Path | None:
    """Returns the directory for compiled leaves, or None if it cannot be written (then: memory
    only).
    """
    try:
        directory = _cache_root() / "trilat-net" / _core_digest()
        directory.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: no home directory
        return None
    return directory if os.access(directory, os.W_OK) else None


_config: Any = numba.config  # made at import from the environment; its stubs name no options
_CACHE = None if _config.DISABLE_JIT else _writable_cache()
_SHIPPED = Path(__file__).parent / "compiled" / _core_digest()
_ships = _SHIPPED.is_dir()


def is_core_cached() -> bool:
    """True if there is machine code of a whole tick of this version of the core, which is
    compiled last.
    """
    folders = (
        folder for folder in (_CACHE, _SHIPPED if _ships else None) if folder is not None
    )
    return any(next(folder.rglob("kernel.site_tick-*.nbc"), None) for folder in folders)


COMPILING = "compiling, once for this machine and each number of joints: half a minute, or minutes of a busy one ..."


class _CompilingNotice(event.Listener):
    """Says once, wherever errors go, why the first run takes longer; a signal may end it at any
    time.
    """

    def __init__(self) -> None:
        self.is_reported = False
        self.report: Callable[[str], None] = partial(print, file=sys.stderr, flush=True)
        self._restore: list[Callable[[], None]] = []  # of compilations inside one another

    def on_start(self, begun: Any) -> None:
        """Says so as anything of the core is compiled."""
        self._restore.append(end_process_at_signals())
        if not self.is_reported and begun.data["dispatcher"].py_func.__module__.startswith(
            __package__
        ):
            self.is_reported = True
            self.report(COMPILING)

    def on_end(self, _: Any) -> None:
        """Says nothing."""
        self._restore.pop()()


compiling_notice = _CompilingNotice()
_register: Any = event.register
_register("numba:compile", compiling_notice)


def _mangle_record(record: types.Record) -> tuple[str, tuple[str]]:
    """Names a record in the symbols of machine code by its fields.

    Numba numbers records in the order in which a process meets them. Leaves that two processes
    compiled for two layouts then have the same symbols, and a third process that loads both
    from the cache mixes them up.
    """
    return "Record", (f"r{hashlib.sha256(record.name.encode()).hexdigest()[:16]}",)


_record: Any = types.Record
_record.mangling_args = property(_mangle_record)

_OPTIONS: Any = {"_nrt": False}
"""No leaf makes an array, so no reference is counted, which would cost more than the arithmetic
does.
"""
_WITHIN = "within"  # another leaf, compiled as a part of it


class _Place:
    """Where the machine code of a function is kept, as Numba asks for it; its source counts by
    content.
    """

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._line = function.__code__.co_firstlineno
        self._py_file = Path(file)

    from_function = classmethod(lambda cls, function, file: cls(function, file))

    def get_cache_path(self) -> str:
        return str((_CACHE or _SHIPPED) / self._py_file.parent.name)

    def get_source_stamp(self) -> str:
        return hashlib.sha256(self._py_file.read_bytes()).hexdigest()

    def get_disambiguator(self) -> str:
        return str(self._line)

    def ensure_cache_path(self) -> None:
        Path(self.get_cache_path()).mkdir(parents=True, exist_ok=True)


class _Placed(CompileResultCacheImpl):
    """How the machine code of a leaf is kept; of one within others it is what LLVM optimises
    later.
    """

    _locator_classes = cast(Any, [_Place])

    def rebuild(self, context: Any, kept: Any) -> Any:
        name, kind, code = kept[0]
        if kind != _WITHIN:
            return super().rebuild(context, kept)
        library = _LeafLibrary(context.codegen(), name)
        library.within = True
        library._finalized = True
        library._final_module = parse_bitcode(code)
        names = (
            "fndesc",
            "environment",
            "signature",
            "objectmode",
            "lifted",
            "type_annotation",
        )
        fields = dict(zip((*names, "reload_init", "referenced_envs"), kept[1:], strict=True))
        contexts = {"target_context": context, "typing_context": context.typing_context}
        return _within(compile_result(library=library, **contexts, **fields))


class _CodeFiles(IndexDataCacheFile):
    """The files of one function, compressed to a quarter.

    Numba numbers them, and two processes may write other code into one.
    """

    def save(self, key: Any, code: Any) -> None:
        names = self._load_index()
        first, _, last = self._data_name(0).rpartition(".0.")
        names[key] = f"{first}.{hashlib.sha256(repr(key).encode()).hexdigest()[:8]}.{last}"
        self._save_index(names)
        self._save_data(names[key], code)

    def _save_data(self, name: str, code: Any) -> None:
        with self._open_for_write(self._data_path(name)) as file:
            file.write(zlib.compress(self._dump(code), 1))

    def _load_data(self, name: str) -> Any:
        return pickle.loads(zlib.decompress(Path(self._data_path(name)).read_bytes()))


class _LeafCache(FunctionCache):
    """Machine code of a leaf: the user's, for this processor, else what came with the wheel."""

    _impl_class = _Placed

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        base = self._impl.filename_base
        stamp = self._cache_file._source_stamp
        place = Path(self._cache_path)
        files = cast(Any, _CodeFiles)
        self._cache_file = files(str(place), base, stamp)
        self._shipped = files(str(_SHIPPED / place.name), base, stamp)
        self._within = files(str(place), f"{base}-within", stamp)

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Returns what is kept, or None; Numba first readies itself to compile, which takes far
        longer.
        """
        with self._guard_against_spurious_io_errors():
            found = self._load_overload(signature, context)
            if found is None and _ships:
                triple = context.codegen().magic_tuple()[0]
                generic = SimpleNamespace(magic_tuple=lambda: (triple, "generic", ""))
                kept = self._shipped.load(self._index_key(signature, generic))
                found = None if kept is None else self._impl.rebuild(context, kept)
            return found

    def _save_overload(self, signature: Any, made: Any) -> None:
        if _CACHE is not None:
            super()._save_overload(signature, made)

    def load_within(self, kinds: Any, context: Any) -> Any:
        kept = self._within.load(self._index_key(kinds, context.codegen()))
        return None if kept is None else self._impl.rebuild(context, kept)

    def save_within(self, kinds: Any, made: Any) -> None:
        if _CACHE is not None:
            self._impl.locator.ensure_cache_path()
            self._within.save(self._index_key(kinds, made.codegen), self._impl.reduce(made))


class _LeafLibrary(JITCodeLibrary):
    """The code of a leaf; that of one within another is neither optimised nor made executable
    by itself.

    It is optimised as a part of whatever calls it, once. Numba does so at every leaf between as
    well, and has wrappers for calls from Python at each: half of the time to compile.
    """

    within = False

    def serialize_using_object_code(self) -> tuple[str, str, Any]:
        if not self.within:
            return super().serialize_using_object_code()
        return self.name, _WITHIN, self._get_module_for_linking().as_bitcode()

    def _optimize_final_module(self) -> None:
        if not self.within:
            super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        if self.within:
            self._finalized = True
        else:
            super()._finalize_final_module()


def _within(made: Any) -> Any:
    """Returns a leaf within others as they find it: by an object in place of what Python would
    call.
    """
    made = made._replace(entry_point=object())
    made.target_context.insert_user_function(made.entry_point, made.fndesc, [made.library])
    return made


class _LeafCompiler(Compiler):
    """Compiles a leaf, within another one or for calls from Python."""

    depth = 0

    def compile_extra(self, function: Any) -> Any:
        state = self.state
        within = _LeafCompiler.depth > 0
        state.library = _LeafLibrary(state.targetctx.codegen(), function.__qualname__)
        state.library.enable_object_caching()
        state.library.within = within
        if within:
            state.flags.no_compile = state.flags.no_cpython_wrapper = (
                state.flags.no_cfunc_wrapper
            ) = True
        _LeafCompiler.depth += 1
        try:
            made = super().compile_extra(function)
        finally:
            _LeafCompiler.depth -= 1
        if within:
            return _within(made)
        for environment in made._find_referenced_environments():  # of leaves within it
            made.library.codegen.set_env(environment.env_name, environment)
        return made


class _Leaf(CPUDispatcher):
    """A leaf, compiled anew for calls from Python where so far it was within others only."""

    _cache: Any
    _compiler: Any

    def get_call_template(self, arguments: Any, named: Any) -> Any:
        """Returns what a caller is to know: not one leaf for every constant that somebody
        passes.
        """
        plain = {name: types.unliteral(one) for name, one in named.items()}
        return super().get_call_template(tuple(map(types.unliteral, arguments)), plain)

    def add_overload(self, made: Any) -> None:
        """Takes in what was compiled; Python is not to call what is within a leaf."""
        if getattr(made.library, "within", False):
            self.overloads[tuple(made.signature.args)] = made
        else:
            super().add_overload(made)

    def compile(self, signature: Any) -> Any:
        """Returns what is to be called for arguments of these types."""
        with global_compiler_lock:
            kinds, result = normalize_signature(signature)
            known: Any = self.overloads.get(kinds)
            if _LeafCompiler.depth == 0:
                if known is not None and getattr(known.library, "within", False):
                    del self.overloads[kinds]
                return super().compile(signature)
            if known is None:
                known = self._cache.load_within(kinds, self.targetctx)
                if known is None:
                    with event.trigger_event(
                        "numba:compile", data={"dispatcher": self, "args": kinds}
                    ):
                        known = self._compiler.compile(kinds, result)
                    self._cache.save_within(kinds, known)
                self.add_overload(known)
            return known.entry_point


def bind_leaf(function: Callable[P, R], *arguments: P.args, **_: P.kwargs) -> Callable[P, R]:
    """Returns a leaf for arguments of the types of these; it does not look at types any more."""
    if _config.DISABLE_JIT:
        return function
    compiled: Any = function
    return cast(Callable[P, R], compiled.compile(tuple(map(numba.typeof, arguments))))


def leaf(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a function of numbers and arrays; its type, as seen by a reader or mypy, stays
    the same.
    """
    if _config.DISABLE_JIT:
        return function
    options = {"nopython": True, "boundscheck": None, **_OPTIONS}
    made = cast(Any, _Leaf)(function, targetoptions=options, pipeline_class=_LeafCompiler)
    made._cache = cast(Any, _LeafCache)(function)
    return cast(Callable[P, R], made)


class _NamedCache(_LeafCache):
    """Machine code of a function whose name tells all that it is made of, what it closes over
    too.
    """

    def _index_key(self, signature: Any, codegen: Any) -> tuple[Any, Any]:
        return signature, codegen.magic_tuple()


def compile_named(
    function: Callable[..., None], name: str, signature: Any, **options: Any
) -> Any:
    """Compiles a closure for a signature, or loads it if one of this name was compiled before.

    The name goes into the symbols of the machine code: no two closures may share one in any
    process.
    """
    function.__qualname__ = name
    # what is only loaded counts no references
    dispatcher = numba.njit(**{**options, **_OPTIONS})(function)
    dispatcher._cache = cast(Any, _NamedCache)(function)
    dispatcher.compile(signature)
    return dispatcher
