"""Loops that numba compiles at their first call, and whose machine code later processes load without numba.

Importing numba and loading code from its cache takes half a second in each process. So the machine code of each loop is
kept in a file, which is loaded by llvmlite, the library under numba, and called by numba's calling convention
(https://numba.readthedocs.io/en/stable/developer/repr.html).
"""

from __future__ import annotations

import ctypes
import functools
import gc
import hashlib
import json
import operator
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import RLock
from typing import Any, NamedTuple

import numpy as np

from jetnormal.support.report import logger

FASTMATH = ("contract", "reassoc", "nsz")  # NaN and infinity mean what they mean
OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "_nrt": False,  # no counts of references: nothing is allocated
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}
_lock = RLock()
_no_result = ctypes.c_void_p()
_ignored = ctypes.addressof(_no_result)  # where functions that return nothing write that they do
_Kind = tuple[Any, int]  # type and number of dimensions of an argument


class _Code(NamedTuple):
    """Machine code: an object file, the name of the function in it, and what it calls from outside."""

    symbol: str
    externals: list[str]
    content: bytes


class Compiled:
    """A function of C-contiguous arrays, integers and floats that writes into the arrays; see `compiled`."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.__doc__ = function.__doc__
        self._function = function
        self._name = f"{function.__module__}.{function.__name__}"
        self._ready: dict[tuple[_Kind, ...], Callable[..., int]] = {}

    def __call__(self, *arguments: Any) -> None:
        kinds: list[_Kind] = []
        values: list[Any] = [_ignored, _ignored]
        for argument in arguments:
            if isinstance(argument, np.ndarray):
                if not argument.flags.c_contiguous:
                    raise ValueError(f"{self._name} takes C-contiguous arrays")
                kinds.append((argument.dtype, argument.ndim))
                values += (0, 0, argument.size, argument.itemsize, argument.ctypes.data)
                values += argument.shape
                values += argument.strides
            else:
                is_float = isinstance(argument, float)
                kinds.append(("float" if is_float else "int", 0))
                values.append(argument if is_float else operator.index(argument))
        signature = tuple(kinds)
        call = self._ready.get(signature)
        if call is None:
            call = self._prepare(signature)
        call(*values)

    @functools.cached_property
    def dispatcher(self) -> Any:
        """The function as numba knows it."""
        from numba import njit

        return njit(fastmath=set(FASTMATH), **OPTIONS)(self._function)

    @property
    def _numba_type_(self) -> Any:
        """Lets numba call the function from another that it compiles."""
        from numba import types

        return types.Dispatcher(self.dispatcher)

    def _prepare(self, signature: tuple[_Kind, ...]) -> Callable[..., int]:
        """The machine code for such arguments, ready to be called."""
        with _lock:
            if signature not in self._ready:
                said = repr((signature, list(_content(self._function)), _machine()))
                name = f"{self._name}-{hashlib.sha256(said.encode()).hexdigest()[:24]}.o"
                code = _kept(name)
                if code is None:
                    _announce()
                    with _uncollected():
                        code = self._compile(signature)
                    _keep(name, code)
                self._ready[signature] = _load(code, signature)
            return self._ready[signature]

    def _compile(self, signature: tuple[_Kind, ...]) -> _Code:
        from llvmlite import binding
        from numba import from_dtype, types
        from numba.core.registry import cpu_target

        scalars = {"float": types.float64, "int": types.int64}
        parameters = tuple(
            types.Array(from_dtype(kind), dimensions, "C") if isinstance(kind, np.dtype) else scalars[kind]
            for kind, dimensions in signature
        )
        self.dispatcher.compile(parameters)
        made = self.dispatcher.overloads[parameters]
        if made.signature.return_type != types.none:
            raise TypeError(f"{self._name} returns a value: a compiled function writes into arrays")
        module = binding.parse_assembly(self.dispatcher.inspect_llvm(parameters))
        symbol = made.fndesc.llvm_func_name
        passed = [argument.type for argument in module.get_function(symbol).arguments]
        found = ["ptr" if kind.is_pointer else str(kind) for kind in passed]
        if found != _convention(signature):
            raise RuntimeError(f"this version of numba calls functions in another way: {found}")
        externals = [f.name for f in module.functions if f.is_declaration and not f.name.startswith("llvm.")]
        return _Code(symbol, externals, cpu_target.target_context.codegen()._tm.emit_object(module))


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a function of C-contiguous arrays, integers and floats; it runs without the interpreter lock.

    It writes its results into arrays: it allocates none and returns nothing, unless only other compiled functions call
    it. Sums may be reordered and products fused. The machine code is kept in the user's cache folder (or where
    NUMBA_CACHE_DIR says), else beside the package: an uninstallation would leave it there. Where neither can be
    written, each process compiles anew.
    """
    return Compiled(function)


@contextmanager
def _uncollected() -> Iterator[None]:
    """Collect no garbage meanwhile: a seventh of the time that numba takes goes to looking through what it keeps."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


@functools.cache
def _announce() -> None:
    logger.info("compiling loops for this machine: some seconds, this once")


def _convention(signature: tuple[_Kind, ...]) -> list[str]:
    """The types that numba's calling convention has for such arguments."""
    scalars = {"float": ["double"], "int": ["i64"]}
    found = ["ptr", "ptr"]  # for the result and an exception
    for kind, dimensions in signature:
        array = ["ptr", "ptr", "i64", "i64", "ptr"] + 2 * dimensions * ["i64"]
        found += array if isinstance(kind, np.dtype) else scalars[kind]
    return found


def _content(function: Callable[..., Any]) -> Iterator[Any]:
    """What decides about the machine code of a function: its own code, that of what it calls, and global numbers."""
    code = function.__code__
    yield code.co_code, code.co_names, code.co_varnames, code.co_consts
    for name in code.co_names:
        value = function.__globals__.get(name)
        if isinstance(value, Compiled):
            yield from _content(value._function)
        elif isinstance(value, (bool, int, float)):
            yield name, value


def _machine() -> tuple[str, ...]:
    """What the machine code runs on, and what makes it."""
    import llvmlite
    from llvmlite import binding

    processor = binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()
    return llvmlite.__version__, binding.get_process_triple(), *processor, *FASTMATH, repr(OPTIONS)


@functools.cache
def _engine() -> Any:
    """What holds the machine code of this process."""
    from llvmlite import binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    machine = binding.Target.from_triple(binding.get_process_triple()).create_target_machine(jit=True)
    return binding.create_mcjit_compiler(binding.parse_assembly(""), machine)


def _load(code: _Code, signature: tuple[_Kind, ...]) -> Callable[..., int]:
    from llvmlite import binding

    engine = _engine()
    if not all(map(binding.address_of_symbol, code.externals)):  # of a mathematical library that numba brings along
        from numba.core.registry import cpu_target

        assert cpu_target.target_context
    engine.add_object_file(binding.ObjectFileRef.from_data(code.content))
    engine.finalize_object()
    types = {"ptr": ctypes.c_void_p, "i64": ctypes.c_int64, "double": ctypes.c_double}
    call = ctypes.CFUNCTYPE(ctypes.c_int32, *(types[kind] for kind in _convention(signature)))
    return call(engine.get_function_address(code.symbol))


def _folders() -> list[Path]:
    """Where machine code may be kept, the best place first."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    own = Path(chosen) if chosen else _user_cache() / "jetnormal" / "compiled"
    return [own, Path(__file__).parent / "__pycache__"]


def _user_cache() -> Path:
    """Where programs of this user keep what they can make again."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home())
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def _kept(name: str) -> _Code | None:
    """The machine code in a file of that name; None if there is none, or it is damaged."""
    for folder in _folders():
        with suppress(OSError, ValueError, LookupError, TypeError):
            header, _, content = (folder / name).read_bytes().partition(b"\n")
            said = json.loads(header)
            if said["sha256"] == hashlib.sha256(content).hexdigest():
                return _Code(said["symbol"], said["externals"], content)
    return None


def _keep(name: str, code: _Code) -> None:
    """Write machine code where that is possible; another process sees all of the file or nothing."""
    said = {"symbol": code.symbol, "externals": code.externals, "sha256": hashlib.sha256(code.content).hexdigest()}
    for folder in _folders():
        unfinished = folder / f"{name}.{os.getpid()}"
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            unfinished.write_bytes(json.dumps(said).encode() + b"\n" + code.content)
            unfinished.replace(folder / name)
            return
