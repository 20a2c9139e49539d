"""The one typed wrapper around Numba.

Invariant: a leaf is compiled for float64 without reordering (no fastmath), so compiled and plain Python
runs give the same bits. Machine code is cached in the user's cache directory, in a folder named after a
hash of all sources of the core: Numba alone notices a change of the file that holds a leaf, not of the
leaves it calls.
"""

import hashlib
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba
from numba.core import event
from numba.core.caching import FunctionCache

from ..process import let_signals_kill

P = ParamSpec("P")
R = TypeVar("R")

with suppress(OSError, IndexError):  # of Linux alone
    _addresses = Path("/proc/self/limits").read_text("utf-8").partition("Max address space")[2].split()[0]
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
    """Returns the directory for compiled leaves, or None if it cannot be written (then: memory only)."""
    try:
        directory = _cache_root() / "trilat-net" / _core_digest()
        directory.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: no home directory
        return None
    return directory if os.access(directory, os.W_OK) else None


_config: Any = numba.config  # made at import from the environment; its stubs name no options
_CACHE = None if _config.DISABLE_JIT else _writable_cache()


def is_core_cached() -> bool:
    """True if the cache holds a whole tick of this version of the core, which is compiled last."""
    return _CACHE is not None and next(_CACHE.rglob("kernel.site_tick-*.nbc"), None) is not None


COMPILING = "compiling, once for this machine and each number of joints ..."


class _CompilingNotice(event.Listener):
    """Says once, wherever errors go, why the first run takes longer; a signal may end it at any time."""

    def __init__(self) -> None:
        self.said = False
        self._restore: list[Callable[[], None]] = []  # of compilations inside one another

    def on_start(self, begun: Any) -> None:
        """Says so as anything of the core is compiled."""
        self._restore.append(let_signals_kill())
        if not self.said and begun.data["dispatcher"].py_func.__module__.startswith(__package__):
            self.said = True
            print(COMPILING, file=sys.stderr, flush=True)

    def on_end(self, _: Any) -> None:
        """Says nothing."""
        self._restore.pop()()


compiling_notice = _CompilingNotice()
_register: Any = event.register
_register("numba:compile", compiling_notice)


def _mangle_record(record: numba.types.Record) -> tuple[str, tuple[str]]:
    """Names a record in the symbols of machine code by its fields.

    Numba numbers records in the order in which a process meets them. Leaves that two processes compiled for
    two layouts then have the same symbols, and a third process that loads both from the cache mixes them up.
    """
    return "Record", (f"r{hashlib.sha256(record.name.encode()).hexdigest()[:16]}",)


_record: Any = numba.types.Record
_record.mangling_args = property(_mangle_record)

_OPTIONS: Any = {"_nrt": False}
"""No leaf makes an array, so no reference is counted, which would cost more than the arithmetic does."""


def bind_leaf(function: Callable[P, R], *arguments: P.args, **_: P.kwargs) -> Callable[P, R]:
    """Returns a leaf for arguments of the types of these; it does not look at types any more."""
    if _config.DISABLE_JIT:
        return function
    compiled: Any = function
    return cast(Callable[P, R], compiled.compile(tuple(map(numba.typeof, arguments))))


def _at_cache(make: Callable[[], R]) -> R:
    """Makes something of Numba's whose machine code is kept in the directory for compiled leaves."""
    before = _config.CACHE_DIR
    _config.CACHE_DIR = str(_CACHE)
    try:
        return make()
    finally:
        _config.CACHE_DIR = before


def leaf(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a function of numbers and arrays; its type, as seen by a reader or mypy, stays the same."""
    if _CACHE is None:
        return cast(Callable[P, R], numba.njit(**_OPTIONS)(function))
    return _at_cache(lambda: cast(Callable[P, R], numba.njit(cache=True, **_OPTIONS)(function)))


class _NamedCache(FunctionCache):
    """Machine code of a function whose name tells all that it is made of, what it closes over too."""

    def _index_key(self, signature: Any, codegen: Any) -> tuple[Any, Any]:
        return signature, codegen.magic_tuple()


def compile_named(function: Callable[..., None], name: str, signature: Any, **options: Any) -> Any:
    """Compiles a closure for a signature, or loads it if one of this name was compiled before.

    The name goes into the symbols of the machine code: no two closures may share one in any process.
    """
    function.__qualname__ = name
    dispatcher = numba.njit(**options)(function)
    if _CACHE is not None:
        dispatcher._cache = _at_cache(lambda: cast(Any, _NamedCache)(function))
    dispatcher.compile(signature)
    return dispatcher
