# mypy: disallow-untyped-calls=False, disable-error-code="no-any-return"
"""Compiles numerical functions with Numba, and caches their machine code on disk.

A function decorated with `leaf` is compiled on its first call. Compiling the whole core is
slow, so later processes load the cached code instead. Numba's own cache is not used, because it
does not notice when a function called by a cached function changes.

- The code is stored in a folder of the user's cache directory. The folder is named after a hash
  of all source files of this package, and of `records.py`, whose constants are compiled in.
- Binary wheels ship the same kind of folder, with code that runs on any processor of their
  platform. It is used if the cache directory has no code for the current processor.
- An inner leaf, which is only called by other compiled functions, is stored as unoptimised LLVM
  code, since it is optimised together with its caller. All other functions are stored as
  machine code only, which halves the size of the files and speeds up the start of a command.

Invariant:
    - Floating-point operations are not reordered (no fastmath), so compiled functions and plain
      Python produce identical bits.
    - Compilation and caching of other Numba code in the process are not affected.
"""

import hashlib
import os
import pickle
import re
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ParamSpec, TypeVar, cast

import numba
from llvmlite.binding import parse_assembly, parse_bitcode
from numba.core import event, types
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    NullCache,
)
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, compile_result
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature

from ...signals import end_process_at_signals

P = ParamSpec("P")
R = TypeVar("R")

# With little address space, LLVM and OpenBLAS would abort, or retry for ever without reacting
# to signals.
with suppress(OSError, IndexError):  # only Linux has the file
    _limits = Path("/proc/self/limits").read_text("utf-8")
    _address_space = _limits.partition("Max address space")[2].split()[0]
    if _address_space != "unlimited" and int(_address_space) < 1 << 30:
        raise MemoryError


_CORE = Path(__file__).parents[1]
"""Folder of the core, which contains this package."""
_CORE_PACKAGE = __package__.rpartition(".")[0]
"""Name of the core package."""


def _cache_root() -> Path:
    """Returns the user's cache directory, in which programs may keep files for faster starts.

    This is ~/.cache on Linux, unless XDG_CACHE_HOME names another directory, and the equivalent
    directory on other platforms.
    """
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))


def _core_digest() -> str:
    """Returns a hash that shows whether machine code on disk was compiled from these sources.

    It covers Numba's version, the files of the core, and `records`, whose constants are
    compiled into the core.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for source in (*sorted(_CORE.rglob("*.py")), _CORE.with_name("records.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _writable_cache() -> Path | None:
    """Returns the directory in which compiled functions are stored, creating it if necessary.

    Returns None if the directory is not writable. Compiled functions are then kept in memory
    only.
    """
    try:
        directory = _cache_root() / "trilat-net" / _core_digest()
        directory.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: no home directory
        return None
    return directory if os.access(directory, os.W_OK) else None


_config: Any = numba.config  # set from the environment at import; its stubs name no options
_CACHE = None if _config.DISABLE_JIT else _writable_cache()
_SHIPPED = _CORE / "compiled" / _core_digest()
_ships = _SHIPPED.is_dir()


def is_core_cached() -> bool:
    """Returns True if a simulation can start immediately, without compiling the core first.

    Commands use this result to announce that the first run will take longer. Only the function
    `kernel.site_tick` is looked up on disk: it is compiled last, so if it is there, the other
    functions are too.
    """
    folders = [_CACHE, _SHIPPED if _ships else None]
    for folder in folders:
        if folder is None:
            continue
        files = folder.rglob("kernel.site_tick-*.nbc")
        if any(files):
            return True
    return False


COMPILING = (
    "compiling, once for this machine and each number of joints: "
    "half a minute, or minutes if the machine is busy ..."
)


class _CompilingNotice(event.Listener):
    """Prints a one-time notice that the core is being compiled, which delays a first run.

    Numba calls this object at the start and end of each compilation. During a compilation,
    signals such as Ctrl-C end the process immediately.

    Attributes:
        is_reported: True if the notice has been printed, or must not be.
        report: Function that prints the notice, by default to standard error.
    """

    def __init__(self) -> None:
        self.is_reported = False
        self.report: Callable[[str], None] = partial(print, file=sys.stderr, flush=True)
        # Compilations may be nested, so each one restores the signal handlers that it found.
        self._restorers: list[Callable[[], None]] = []

    def on_start(self, event_data: Any) -> None:
        """Prints a notice before the first compilation of a core function, which is slow.

        Numba calls this method at the start of each compilation. While the compilation is
        running, signals such as Ctrl-C end the process immediately.

        Args:
            event_data: Numba's description of the compilation.
        """
        self._restorers.append(end_process_at_signals())
        function = event_data.data["dispatcher"].py_func
        # Wrappers of the laws and models of users are compiled in every process.
        is_wrapper = "<locals>" in function.__qualname__
        is_core = function.__module__.startswith(_CORE_PACKAGE) and not is_wrapper
        if is_core and not self.is_reported:
            self.is_reported = True
            self.report(COMPILING)

    def on_end(self, _: Any) -> None:
        """Restores the signal handlers when Numba reports the end of a compilation."""
        restore = self._restorers.pop()
        restore()


compiling_notice = _CompilingNotice()
_register: Any = event.register
_register("numba:compile", compiling_notice)


def _mangle_record(record: types.Record) -> tuple[str, tuple[str]]:
    """Returns a unique name for a record type, used in the symbols of compiled functions.

    A record type describes the rows of a structured array. Numba itself numbers these types in
    the order in which a process uses them. Two processes could therefore compile functions for
    different types under the same symbol, and a third process that loads both from the cache
    would mix them up. To prevent this, the name returned here is a hash of the type's fields.
    """
    digest = hashlib.sha256(record.name.encode()).hexdigest()
    return "Record", (f"r{digest[:16]}",)


_record: Any = types.Record
_record.mangling_args = property(_mangle_record)

_OPTIONS: Any = {"_nrt": False}
"""Numba options of leaves.

Reference counting would cost more than the arithmetic, and is not needed because leaves
allocate no arrays.
"""
_LEAF_OPTIONS: Any = {
    "nopython": True,
    "boundscheck": None,
    # A division by zero gives inf or NaN, which stage 7 of a tick finds. An error would need a
    # branch, which keeps loops over several runs from using vector instructions.
    "error_model": "numpy",
    **_OPTIONS,
}
_INNER = "within"
"""Marks stored code as that of an inner leaf."""
_NO_LLVM_CODE = parse_assembly("").as_bitcode()
"""An empty LLVM module."""


@cache
def _hash_folder(folder: Path) -> str:
    """Returns a hash of all Python files in a folder, to detect outdated machine code.

    Used for functions outside the core. If a file changes, the hash changes, and machine code
    stored under the old hash is no longer used.
    """
    digest = hashlib.sha256()
    for source in sorted(folder.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()


class _LeafLocator:
    """Tells Numba where the machine code of a function is stored, and when it is out of date.

    By default, Numba checks the modification time of the function's file. This class compares a
    hash of all files in the folder of the function instead, because the function may call
    functions in these files.
    """

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._line = function.__code__.co_firstlineno
        self._py_file = Path(file)

    from_function = classmethod(lambda cls, function, file: cls(function, file))

    def get_cache_path(self) -> str:
        root = _CACHE or _SHIPPED
        return str(root / self._py_file.parent.name)

    def get_source_stamp(self) -> str:
        # The directory is named after a hash of the core, but some leaves are outside the core.
        return _hash_folder(self._py_file.parent)

    def get_disambiguator(self) -> str:
        return str(self._line)

    def ensure_cache_path(self) -> None:
        Path(self.get_cache_path()).mkdir(parents=True, exist_ok=True)


class _LeafCacheImpl(CompileResultCacheImpl):
    """Converts compiled functions to the content of cache files, and back.

    A function that is only called by other compiled functions (an inner leaf) is stored as LLVM
    code, all others as machine code.
    """

    _locator_classes = cast(Any, [_LeafLocator])

    def rebuild(self, context: Any, content: Any) -> Any:
        """Converts the content of a cache file to a compiled function.

        If the file contains machine code, Numba itself converts it. If the file contains LLVM
        code, this method creates the objects that Numba would have after a compilation. Numba
        has no public interface for this conversion, so private names are used.

        Args:
            context: Numba's description of the target processor.
            content: Content of the file, as written by `CompileResult._reduce`. The first entry
                was returned by `_LeafLibrary.serialize_using_object_code`; the others are the
                positional arguments of `compile_result`.

        Returns:
            Numba's description of the compiled function.
        """
        name, kind, code = content[0]
        is_inner = kind == _INNER
        if not is_inner:
            # Numba would read the function names from the LLVM code.
            function = content[1]
            symbols = {function.llvm_func_name, function.llvm_cpython_wrapper_name}
            context.codegen()._engine._defined_symbols.update(symbols)
            return super().rebuild(context, content)

        library = _LeafLibrary(context.codegen(), name)
        library.is_inner = True
        # No machine code is needed, so the library is complete once it has LLVM code.
        library._finalized = True
        library._final_module = parse_bitcode(code)
        # In the order used by `CompileResult._reduce`.
        names = (
            "fndesc",
            "environment",
            "signature",
            "objectmode",
            "lifted",
            "type_annotation",
            "reload_init",
            "referenced_envs",
        )
        fields = dict(zip(names, content[1:], strict=True))
        result = compile_result(
            library=library,
            target_context=context,
            typing_context=context.typing_context,
            **fields,
        )
        return _as_inner(result)


class _CompressedFiles(IndexDataCacheFile):
    """Cache files of one compiled function, compressed to a quarter of their size.

    Numba would number the files, so two processes could write different code to the same file.
    In this class, the name of a file contains a hash of its key instead.
    """

    def save(self, key: Any, code: Any) -> None:
        """Writes compiled code to a file, and adds the file to the cache index.

        The index maps each key to a file name. Numba itself would number the files, so two
        processes that compile at the same time could choose the same number. The names used
        here contain a hash of the key instead.

        Args:
            key: Argument types and processor for which the code was compiled.
            code: The compiled code, as serialised by Numba.
        """
        names = self._load_index()
        # Numba's name for file 0 is "FUNCTION.0.SUFFIX": the hash replaces the number.
        prefix, _, suffix = self._data_name(0).rpartition(".0.")
        digest = hashlib.sha256(repr(key).encode()).hexdigest()[:8]
        name = f"{prefix}.{digest}.{suffix}"
        names[key] = name
        self._save_index(names)
        self._save_data(name, code)

    def _save_data(self, name: str, code: Any) -> None:
        content = zlib.compress(self._dump(code), 1)
        with self._open_for_write(self._data_path(name)) as file:
            file.write(content)

    def _load_data(self, name: str) -> Any:
        path = Path(self._data_path(name))
        content = zlib.decompress(path.read_bytes())
        return pickle.loads(content)


class _LeafCache(FunctionCache):
    """Stores the machine code of one compiled function on disk, and loads it.

    Code is read from the user's cache directory, or failing that, from the installed wheel. New
    code is written to the user's cache directory.
    """

    _impl_class = _LeafCacheImpl

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        base = self._impl.filename_base
        stamp = self._cache_file._source_stamp
        folder = Path(self._cache_path)
        shipped_folder = _SHIPPED / folder.name
        files = cast(Any, _CompressedFiles)
        self._cache_file = files(str(folder), base, stamp)
        self._shipped = files(str(shipped_folder), base, stamp)
        self._inner = files(str(folder), f"{base}-within", stamp)

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Loads the machine code of the function for given argument types.

        The user's cache directory is searched first, then the code in the installed wheel.
        Unlike Numba's own method, this one does not initialise the compiler, which would take
        far longer than loading.

        Args:
            signature: Types of the arguments.
            context: Numba's description of the target processor.

        Returns:
            Numba's description of the compiled function, or None if there is no stored code.
        """
        with self._guard_against_spurious_io_errors():
            result = self._load_overload(signature, context)
            if result is not None or not _ships:
                return result
            # The wheel's code is indexed by the platform and a processor named "generic".
            platform = context.codegen().magic_tuple()[0]
            generic_processor = SimpleNamespace(magic_tuple=lambda: (platform, "generic", ""))
            key = self._index_key(signature, generic_processor)
            content = self._shipped.load(key)
            return None if content is None else self._impl.rebuild(context, content)

    def _save_overload(self, signature: Any, result: Any) -> None:
        if _CACHE is not None:
            super()._save_overload(signature, result)

    def load_inner(self, argument_types: Any, context: Any) -> Any:
        """Loads the LLVM code of a function that another compiled function calls.

        LLVM code is the intermediate representation from which the compiler generates machine
        code.

        Args:
            argument_types: Numba types of the arguments.
            context: Numba's description of the target processor.

        Returns:
            Numba's description of the compiled function, or None if the cache has no code for
            these types.
        """
        key = self._index_key(argument_types, context.codegen())
        content = self._inner.load(key)
        return None if content is None else self._impl.rebuild(context, content)

    def save_inner(self, argument_types: Any, result: Any) -> None:
        """Stores the LLVM code of a function that only other compiled functions can call.

        The files are separate from those with machine code, which Python can call. Nothing is
        stored if no cache directory is writable.

        Args:
            argument_types: Numba types of the arguments.
            result: Numba's description of the compiled function.
        """
        has_cache = _CACHE is not None
        if not has_cache:
            return
        self._impl.locator.ensure_cache_path()
        key = self._index_key(argument_types, result.codegen)
        content = self._impl.reduce(result)
        self._inner.save(key, content)


class _LeafLibrary(JITCodeLibrary):
    """Code of one compiled function, either as LLVM code or as machine code.

    A function that is only called by other compiled functions (an inner leaf) is optimised only
    once, as part of its caller. Numba would also optimise it separately, and add a wrapper for
    calls from Python. Skipping both steps halves the compilation time.
    """

    is_inner = False

    def serialize_using_object_code(self) -> tuple[str, str, Any]:
        if self.is_inner:
            module = self._get_module_for_linking()
            return self.name, _INNER, module.as_bitcode()
        # Numba would store the LLVM code too, which is larger than the machine code. A compiled
        # caller loads the LLVM code of the inner leaf instead.
        name, kind, (machine_code, _) = super().serialize_using_object_code()
        return name, kind, (machine_code, _NO_LLVM_CODE)

    def _optimize_final_module(self) -> None:
        if not self.is_inner:
            super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        if self.is_inner:
            self._finalized = True
        else:
            super()._finalize_final_module()


def _as_inner(result: Any) -> Any:
    """Makes a function that exists only as LLVM code available to compiled callers.

    Numba looks up a called function by its entry point, the Python object of its machine code.
    LLVM code has no entry point, so a new object takes its place.
    """
    result = result._replace(entry_point=object())
    context = result.target_context
    context.insert_user_function(result.entry_point, result.fndesc, [result.library])
    return result


class _LeafCompiler(Compiler):
    """Compiles a numerical function (leaf) with Numba, for calls from Python or compiled code.

    A leaf that is compiled because another leaf calls it is an inner leaf, and becomes part of
    its caller.

    Attributes:
        depth: Number of nested callers that are currently being compiled and need leaves.
        library_class: Code class of a leaf that is not an inner leaf.
        has_distinct_arguments: True if the arguments of a leaf that is not an inner leaf never
            overlap in memory.
    """

    depth = 0
    library_class = _LeafLibrary
    has_distinct_arguments = False

    def compile_extra(self, function: Any) -> Any:
        """Compiles a numerical function (leaf) to machine code, or to LLVM code.

        Python can call machine code. LLVM code is produced if another leaf is being compiled at
        the same time, because this leaf is then the caller of the function. The function is
        called an inner leaf, and its LLVM code becomes part of the caller. Called by Numba.

        Args:
            function: The Python function.

        Returns:
            Numba's description of the compiled function.
        """
        state = self.state
        is_inner = _LeafCompiler.depth > 0
        library_class = _LeafLibrary if is_inner else self.library_class
        state.library = library_class(state.targetctx.codegen(), function.__qualname__)
        state.library.enable_object_caching()
        state.library.is_inner = is_inner
        state.flags.noalias = self.has_distinct_arguments and not is_inner
        if is_inner:
            # Generates neither machine code nor wrappers for calls from Python or C.
            state.flags.no_compile = True
            state.flags.no_cpython_wrapper = True
            state.flags.no_cfunc_wrapper = True

        # A leaf that Numba compiles during this compilation is an inner leaf.
        with _compiling_caller():
            result = super().compile_extra(function)

        if is_inner:
            return _as_inner(result)
        # Compiled code finds the global variables of a function in its environment. Usually the
        # wrapper of a function sets it. The inner leaves that this leaf contains have no
        # wrapper, so their environments are set now, when their code is executable.
        for environment in result._find_referenced_environments():
            result.library.codegen.set_env(environment.env_name, environment)
        return result


@contextmanager
def _compiling_caller() -> Iterator[None]:
    """Treats each leaf that Numba compiles or looks up inside the context as an inner leaf."""
    _LeafCompiler.depth += 1
    try:
        yield
    finally:
        _LeafCompiler.depth -= 1


def _prefer_wide_vectors(llvm_code: str) -> str:
    """Makes LLVM use 512-bit vector instructions in the loops of a module.

    By default, LLVM uses 256 bits even on processors with longer registers, because some
    processors lower their clock rate for these. In this program, the arithmetic gains more from
    the longer registers than it loses. Processors without such registers are not affected. The
    source text of the module is edited, because llvmlite cannot set an attribute that has a
    value.

    Args:
        llvm_code: The module as text.
    """
    # The attributes of a function follow its arguments and an optional "unnamed_addr".
    return re.sub(
        r"^(define .*\)(?: (?:local_)?unnamed_addr)?)(?=[^()]*\{$)",
        r'\1 "prefer-vector-width"="512"',
        llvm_code,
        flags=re.MULTILINE,
    )


class _LaneLibrary(_LeafLibrary):
    """Machine code of a function with a long loop, with all functions that it calls inlined.

    The compiler only vectorises loops that contain no calls. Such a loop computes many control
    periods, or several simulations side by side (lanes).
    """

    def _optimize_final_module(self) -> None:
        for function in self._final_module.functions:
            # The names of the function itself and of its wrapper contain the library's name.
            if not function.is_declaration and self.name not in function.name:
                function.add_function_attribute("alwaysinline")
        self._final_module = parse_assembly(_prefer_wide_vectors(str(self._final_module)))
        super()._optimize_final_module()


class _LoopCompiler(_LeafCompiler):
    """Compiles a function with a long loop, inlining all functions that it calls.

    Calls inside the loop would otherwise take up much of its run time.
    """

    library_class = _LaneLibrary


class _LaneCompiler(_LeafCompiler):
    """Compiles a function that computes several simulations side by side, using SIMD.

    Each simulation has a lane, which is a position in the vector registers. The compiler may
    assume that the arguments do not overlap in memory; otherwise, it would not use vector
    instructions.
    """

    library_class = _LaneLibrary
    has_distinct_arguments = True


def _is_in_lanes(numba_type: Any) -> bool:
    """Returns True if a value holds data of several simulations side by side (lanes).

    Args:
        numba_type: Numba type of the value. Types of rows in lanes have the attribute
            `in_lanes`.
    """
    if isinstance(numba_type, types.Array):
        return _is_in_lanes(numba_type.dtype)
    if isinstance(numba_type, types.BaseTuple):
        entry_types: Any = numba_type
        return any(map(_is_in_lanes, entry_types.types))
    return bool(getattr(numba_type, "in_lanes", False))


class _Leaf(CPUDispatcher):
    """Stands in for a numerical function (leaf), and compiles it when it is called.

    Like Numba's dispatchers, it compiles the function for the types of its arguments. A
    function that was compiled as part of another leaf is compiled again for calls from Python.

    Attributes:
        choose_lane_form: Returns the implementation of the leaf for rows in lanes, see
            `set_lane_form`. None if the leaf itself is the implementation.
    """

    _cache: Any
    _compiler: Any

    def __init__(self, function: Any, targetoptions: Any, pipeline_class: Any) -> None:
        super().__init__(function, targetoptions=targetoptions, pipeline_class=pipeline_class)
        self.choose_lane_form: Callable[[tuple[Any, ...]], Callable[..., Any]] | None = None
        self._compiler._get_implementation = self._choose_implementation

    def _choose_implementation(self, arguments: tuple[Any, ...], _keywords: Any) -> Any:
        """Returns the Python function to compile for given argument types.

        This is the function (leaf) itself, unless the arguments belong to several simulations
        side by side (lanes) and a different implementation was registered for these, see
        `set_lane_form`. Called by Numba.
        """
        if self.choose_lane_form is not None and any(map(_is_in_lanes, arguments)):
            return self.choose_lane_form(arguments)
        return self.py_func

    def get_call_template(self, arguments: Any, keywords: Any) -> Any:
        """Returns Numba's typing information for a call with given argument types.

        Constant arguments are treated like any other value of their type, because Numba would
        otherwise recompile the function for each constant. Called by Numba.

        Args:
            arguments: Types of the positional arguments.
            keywords: Types of the keyword arguments, keyed by name.
        """
        plain_arguments = tuple(map(types.unliteral, arguments))
        plain_keywords = {name: types.unliteral(kind) for name, kind in keywords.items()}
        # The caller may be a plain Numba function, such as a user's law. It is also given an
        # inner leaf, because a reference to machine code would be missing when the caller is
        # loaded again.
        with _compiling_caller():
            return super().get_call_template(plain_arguments, plain_keywords)

    def add_overload(self, result: Any) -> None:
        """Registers a compiled form of the function for later calls with the same types.

        A function (leaf) that is called from Python is compiled to machine code. A function
        that is compiled because another leaf calls it (an inner leaf) is stored as LLVM code,
        which Python cannot call. Both forms are added to `overloads`, where compiled callers
        look up a function by its argument types. Numba's own method would also add an inner
        leaf to the table of functions callable from Python. Called by Numba.

        Args:
            result: Numba's description of the compiled form.
        """
        # A library of Numba's own class, unlike a `_LeafLibrary`, lacks the attribute.
        is_inner = getattr(result.library, "is_inner", False)
        if not is_inner:
            super().add_overload(result)
            return
        argument_types = tuple(result.signature.args)
        self.overloads[argument_types] = result

    def compile(self, signature: Any) -> Any:
        """Loads or compiles the function for given argument types.

        A call from Python needs machine code. A call from another function that is being
        compiled needs LLVM code, which is then optimised together with its caller. Both forms
        are stored in `overloads`, keyed by the argument types.

        Args:
            signature: Argument types, in any form that Numba accepts.

        Returns:
            The compiled function. For LLVM code, the placeholder that represents the function
            in Numba's tables.
        """
        with global_compiler_lock:
            argument_types, return_type = normalize_signature(signature)
            compiled: Any = self.overloads.get(argument_types)
            is_called_from_python = _LeafCompiler.depth == 0
            if is_called_from_python:
                if compiled is not None and getattr(compiled.library, "is_inner", False):
                    # Python cannot call LLVM code. Without this entry, Numba compiles again.
                    del self.overloads[argument_types]
                return super().compile(signature)

            # Machine code that was loaded from disk has no LLVM code, which a caller needs.
            if compiled is None or not isinstance(compiled.library, _LeafLibrary):
                compiled = self._load_or_compile_inner(argument_types, return_type)
                self.add_overload(compiled)
            return compiled.entry_point

    def _load_or_compile_inner(self, argument_types: Any, return_type: Any) -> Any:
        """Returns the function as LLVM code that becomes part of a compiled caller.

        The code is loaded from the disk cache if possible. Otherwise, the function is compiled
        and its code is stored.
        """
        # The code of a leaf for several runs side by side (lanes) is not stored. It contains
        # the functions that `set_lane_form` chose for one structure of runs. The types of the
        # arguments do not show this structure.
        is_stored = not any(map(_is_in_lanes, argument_types))
        if is_stored:
            loaded = self._cache.load_inner(argument_types, self.targetctx)
            if loaded is not None:
                return loaded

        # Report the compilation like Numba's own method.
        data = {"dispatcher": self, "args": argument_types}
        with event.trigger_event("numba:compile", data=data):
            compiled = self._compiler.compile(argument_types, return_type)
        if is_stored:
            self._cache.save_inner(argument_types, compiled)
        return compiled


def bind_leaf(function: Callable[P, R], *arguments: P.args, **_: P.kwargs) -> Callable[P, R]:
    """Compiles a function for the types of the given arguments, to avoid checks on each call.

    Used for functions that a control loop calls in every period. The result must only be called
    with arguments of the same types as those given here. If Numba is disabled, returns the
    function itself.

    Args:
        function: A function decorated with `leaf`.
        *arguments: Example arguments.
    """
    if _config.DISABLE_JIT:
        return function
    dispatcher: Any = function
    argument_types = tuple(map(numba.typeof, arguments))
    return cast(Callable[P, R], dispatcher.compile(argument_types))


def leaf(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator that compiles a numerical function with Numba on its first call.

    Unlike with `numba.njit`, the function must not allocate arrays, and the compiled code is
    cached on disk until a source file of this package changes. For type checkers, the decorated
    function has the same type as the original. If Numba is disabled, returns the function
    itself.
    """
    if _config.DISABLE_JIT:
        return function
    return _make_leaf(function, _LeafCompiler)


def _make_leaf(function: Callable[P, R], compiler: type[_LeafCompiler]) -> Callable[P, R]:
    """Wraps a numerical function in an object that compiles it on its first call.

    Args:
        function: The Python function.
        compiler: Compiler class to use.
    """
    dispatcher = cast(Any, _Leaf)(
        function, targetoptions=dict(_LEAF_OPTIONS), pipeline_class=compiler
    )
    dispatcher._cache = cast(Any, _LeafCache)(function)
    return cast(Callable[P, R], dispatcher)


def loop_leaf(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator like `leaf`, for a function with a long loop that calls other functions.

    The compiler inlines these functions into the loop, which saves the cost of passing array
    descriptors to them. From Python, the function is called like one decorated with `leaf`.
    """
    return leaf(function) if _config.DISABLE_JIT else _make_leaf(function, _LoopCompiler)


def lane_leaf(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator for a function that computes several simulations at once, using SIMD.

    Each simulation occupies a lane, which is a position in the processor's vector registers.
    All functions that the decorated function calls are inlined into it. The compiler assumes
    that no two of its arguments overlap in memory, which the caller must ensure. Compiled code
    calls the decorated function by its address, see `LaneCode`.
    """
    return _make_leaf(function, _LaneCompiler)


@cache
def _make_unstored(function: Callable[..., Any]) -> Any:
    """Wraps a function for several simulations side by side, without caching its code on disk.

    It is compiled again in each process.
    """
    dispatcher: Any = _make_leaf(function, _LaneCompiler)
    dispatcher._cache = NullCache()
    return dispatcher


class LaneCode:
    """Machine code of a function that computes several simulations side by side.

    Args:
        function: A function decorated with `lane_leaf`.
        argument_types: Numba types of its arguments.
    """

    def __init__(self, function: Callable[..., Any], argument_types: tuple[Any, ...]) -> None:
        self._dispatcher: Any = function
        self._argument_types = argument_types

    def find_address(self) -> int:
        """Returns the memory address at which other compiled code can call the function.

        Compiles the function if necessary. The code is not cached on disk if any argument type
        has an `is_stored` attribute that is False.
        """
        dispatcher = self._dispatcher
        is_stored = all(getattr(kind, "is_stored", True) for kind in self._argument_types)
        if not is_stored:
            dispatcher = _make_unstored(dispatcher.py_func)
        dispatcher.compile(self._argument_types)
        result = dispatcher.overloads[self._argument_types]
        return int(result.library.get_pointer_to_function(result.fndesc.llvm_func_name))

    def is_stored(self) -> bool:
        """Returns True if the machine code is already in memory or on disk.

        If not, the first use of the function is slow, because the function must be compiled
        first.
        """
        dispatcher = self._dispatcher
        if self._argument_types in dispatcher.overloads:
            return True
        stored = dispatcher._cache
        key = stored._index_key(self._argument_types, dispatcher.targetctx.codegen())
        return key in stored._cache_file._load_index()

    def read_assembly(self) -> str:
        """Returns the assembly code of the function.

        A test uses the assembly code to check that it contains vector instructions, without
        which the function would be slow.
        """
        # Numba has no assembly text for code from the cache.
        compiled = _make_unstored(self._dispatcher.py_func)
        compiled.compile(self._argument_types)
        return str(compiled.overloads[self._argument_types].library.get_asm_str())


def set_lane_form(
    function: Callable[..., Any], choose: Callable[[tuple[Any, ...]], Callable[..., Any]]
) -> None:
    """Registers another version of a function, for code that computes simulations in parallel.

    For example, `compute_law` of `core.lanes.lane_laws` has one version per control law,
    because all simulations that are computed side by side use the same law.

    Args:
        function: A function decorated with `leaf`.
        choose: Function that returns the implementation for given argument types.
    """
    if not _config.DISABLE_JIT:
        dispatcher: Any = function
        dispatcher.choose_lane_form = choose


class _NamedCache(_LeafCache):
    """Caches the machine code of a closure on disk, under a name chosen by the caller.

    Numba would identify the closure by the values of the variables that it captures. In this
    class, the name identifies everything that the code depends on.
    """

    def _index_key(self, signature: Any, codegen: Any) -> tuple[Any, Any]:
        return signature, codegen.magic_tuple()


def compile_named(
    function: Callable[..., None], name: str, signature: Any, **options: Any
) -> Any:
    """Compiles a closure, and caches its machine code on disk under a name.

    If a closure with this name was compiled before, its code is loaded instead. The name must
    therefore be derived from everything that the code depends on, including the variables
    captured by the closure. The name also appears in the symbols of the machine code, so no two
    functions compiled in this way may share a name within a process.

    Args:
        function: The closure. Its qualified name is changed to `name`.
        name: Name of the function.
        signature: Numba signature of the function.
        **options: Options for `numba.njit`. The options common to all functions compiled by
            this module, such as disabling reference counting, take precedence.

    Returns:
        Numba's dispatcher for the compiled function.
    """
    function.__qualname__ = name
    # The common options apply to both new and loaded code: neither counts references.
    dispatcher = numba.njit(**{**options, **_OPTIONS})(function)
    # Numba's own cache cannot store closures under a given name.
    dispatcher._cache = cast(Any, _NamedCache)(function)
    dispatcher.compile(signature)
    return dispatcher
