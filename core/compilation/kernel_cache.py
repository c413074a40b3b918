"""Where zonda's compiled kernels are kept: one file for each kernel, types of arguments and
processor; see `install`.

numba's own cache keeps an index beside numbered files. Two first runs at once may give one number
to two kernels, so that the next run loads the wrong machine code; a truncated file ends the run
with a traceback; and a kernel stays as it was compiled when a function of another module that it
calls has changed. Here a file's name is a hash of all that its content depends on, its content is
checked by a hash, which knows the name too, and it is written under another name first. What others
may have written is not run (`core.storage.own_files`). So files are written by any number of runs
at once, damaged ones are compiled again, and nothing stale is ever loaded. Processes that share the
work (`share`) compile no kernel twice: each locks the name of what it compiles, and who wants the
same waits for it.
"""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import sys
import time
import warnings
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, ClassVar

import llvmlite
import llvmlite.binding as ll
import numba
import numpy as np
from numba.core import caching, codegen, dispatcher, environment
from numba.core.runtime import rtsys
from numba.core.serialize import dumps

from ..storage import user_cache
from ..storage.files import discard, put
from ..storage.own_files import ForeignFile, own_folder, read_own
from .without_cache import CHANGED, left_to_numba

FORMAT = 3
_DIGEST = 16
SUFFIX = ".zkc"

WAIT = 120.0
"""Seconds [s] for which another process's kernel is waited for; then it is compiled here."""


class Taken(Exception):
    """Another process compiles this kernel now."""


class _Claims:
    """What this process compiles, if it shares the work: open, locked files by the path of the
    kernel.
    """

    def __init__(self) -> None:
        self.shared = self.polite = False
        self.held: dict[Path, int] = {}

    def take(self, path: Path) -> None:
        """Claim a kernel, when the process that has it has done with it. Raises `Taken`.

        No two wait for each other: a process holds a kernel and those that call it, and waits for
        one that these call.
        """
        try:
            import fcntl

            handle = os.open(_claim(path), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except (ImportError, OSError):
            return
        end = time.monotonic() + WAIT
        while time.monotonic() < end:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                self.held[path] = handle
                return
            except BlockingIOError:
                if self.polite and not self.held:
                    os.close(handle)
                    raise Taken(path.name) from None
                time.sleep(0.01)
            except OSError:  # a file system without locks
                break
        os.close(handle)

    def release(self, path: Path | None) -> None:
        """Give up a claim, if there is one."""
        if path in self.held:
            discard(_claim(path))
            os.close(self.held.pop(path))


def _claim(path: Path) -> Path:
    return path.with_suffix(".claim")


_CLAIMS = _Claims()


def share(polite: bool = False) -> None:
    """From now on compile nothing that another process that shares compiles at the same time: wait
    for it.

    ``polite``: raise `Taken` instead where no other kernel needs it.
    """
    _CLAIMS.shared, _CLAIMS.polite = True, polite


def install() -> None:
    """Let zonda's kernels be kept as described here; those of other packages stay with numba. Call
    it before any is defined.

    Raises AttributeError where numba's inside has changed.
    """
    inside: Any = dispatcher
    if inside.FunctionCache is not _cache_of:
        inside.FunctionCache = _cache_of


def _cache_of(function: Any) -> Any:
    if str(function.__module__).partition(".")[0] == "zonda":
        try:
            return KernelCache(function)
        except CHANGED as error:
            left_to_numba(error)
    return caching.FunctionCache(function)


class _TriedOnce:
    """Finds the folder of a kernel as numba does, but tries only once whether a file can be made
    there.
    """

    tried: ClassVar[set[str]] = set()

    def ensure_cache_path(self) -> None:
        path = self.get_cache_path()  # type: ignore[attr-defined]
        if path not in self.tried:
            super().ensure_cache_path()  # type: ignore[misc]
            self.tried.add(path)

    def get_source_stamp(self) -> None:
        """Not needed here: numba's is a hash of the module's file."""


class _Reduced(caching.CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes: ClassVar[
        list[Any]
    ] = [  # a numba without them, or told others by NUMBA_CACHE_LOCATOR_CLASSES, tries each time
        type(found.__name__, (_TriedOnce, found), {})
        for found in getattr(caching.CompileResultCacheImpl, "_locator_classes", ())
    ]


class KernelCache(caching.FunctionCache):  # type: ignore[misc]
    """Kept code of one kernel."""

    _impl_class = _Reduced

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        self._cache_file = KernelFiles(self._cache_path, self._impl.filename_base, function)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled kernel, or None where it must be compiled; a damaged file is removed with a
        warning.

        numba's own first makes its compiler ready (``target_context.refresh()``), half a second of
        imports. Kept code needs of that only the addresses of the functions that count references:
        those of numba's other helpers are known from the beginning, but for ``hash`` and
        ``parallel=True``, which no kernel here uses.
        """
        found = self._load(sig, target_context)
        path = self._cache_file.asked
        if found is None and _CLAIMS.shared and path is not None and path not in _CLAIMS.held:
            _CLAIMS.take(path)
            found = self._load(sig, target_context)  # made in the meantime?
            if found is not None:
                _CLAIMS.release(path)
        return found

    def _load(self, sig: Any, target_context: Any) -> Any:
        try:
            rtsys.initialize(target_context)
            with self._guard_against_spurious_io_errors():
                return self._load_overload(sig, target_context)
            return None
        except CHANGED as error:  # the file is whole: its hash was right
            left_to_numba(error)
            return None
        except Exception:  # what unpickling and linking of damaged code may raise has no end
            self._cache_file.give_up()
            return None

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        found = (
            self._cache_file.load(self._index_key(sig, target_context.codegen()))
            if self._enabled
            else None
        )
        if found is None:
            return None
        reduced, bitcode = found
        made = self._impl.rebuild(target_context, reduced)
        if bitcode is not None:
            made.library._shared_module = None
            made.library._get_module_for_linking = cache(partial(ll.parse_bitcode, bitcode))
        return made

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        """Types and processor; numba's own also has the function's code, which `meaning` knows, and
        what it closes over.
        """
        return (
            super()._index_key(sig, codegen)
            if self._py_func.__closure__
            else (sig, _processor(codegen))
        )

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled kernel; where the disk is full or read-only it is compiled again next
        time.
        """
        try:
            super().save_overload(sig, data)
        except OSError as error:
            warnings.warn(
                f"compiled code cannot be kept for the next run: {error.strerror or error}",
                stacklevel=2,
            )
        except CHANGED as error:
            left_to_numba(error)
        finally:
            if _CLAIMS.held:
                _CLAIMS.release(self._cache_file.path(self._index_key(sig, data.codegen)))


@cache
def _processor(codegen: Any) -> Any:
    return codegen.magic_tuple()


def _without_bitcode(reduced: Any) -> Any:
    """(``reduced``, bitcode) of a compiled kernel that numba has reduced to ``reduced``.

    Its library is machine code, and LLVM's bitcode of the kernel and all that it calls, with which
    other kernels that call it are compiled. numba reads both when it loads a kernel, to know the
    names in it: more than half of the time. In its place comes bitcode of the names alone, of
    functions that do nothing, and the true one beside it. A numba whose inside has changed: as it
    is, and None.
    """
    known = hasattr(codegen.CPUCodeLibrary, "_get_module_for_linking") and hasattr(
        codegen.CPUCodeLibrary, "_unserialize"
    )
    with suppress(AttributeError, TypeError, ValueError, RuntimeError):
        (name, kind, (machine, bitcode)), description, *others = reduced
        if known and kind == "object":
            names = [
                getattr(description, f"llvm_{what}_name")
                for what in ("func", "cpython_wrapper", "cfunc_wrapper")
            ]
            defined = [function for function in names if function.encode() in machine]
            text = "".join(f'define void @"{function}"() {{ ret void }}\n' for function in defined)
            return (
                (name, kind, (machine, ll.parse_assembly(text).as_bitcode())),
                description,
                *others,
            ), bitcode
    return reduced, None


class KernelFiles:
    """The files of one kernel; the part of numba's cache that `KernelCache` replaces.

    Parameters
    ----------
    folder
        Where they are.
    base
        What their names begin with.
    function
        The Python function.
    """

    def __init__(self, folder: str, base: str, function: Any) -> None:
        with suppress(OSError, RuntimeError):
            folder = str(own_folder(Path(folder), user_cache.folder() / "kernels"))
        self.folder, self.base, self.function = Path(folder), base, function
        self._meaning = b""
        self.asked: Path | None = None
        """The file that was looked for last."""

    def path(self, key: Any) -> Path:
        """Of the file for ``key``: (signature, processor, hashes of the function)."""
        if not self._meaning:
            self._meaning = meaning(self.function)
        name = hashlib.blake2b(self._meaning + repr(key).encode(), digest_size=16).hexdigest()
        return self.folder / f"{self.base}.{name}{SUFFIX}"

    def load(self, key: Any) -> Any:
        """What was kept under ``key``, or None."""
        path = self.asked = self.path(key)
        try:
            content = read_own(path)
        except ForeignFile as error:
            warnings.warn(f"compiled code is not taken from {path}: {error}", stacklevel=2)
            self.asked = None
            return None
        except OSError:
            return None
        body = memoryview(content)[_DIGEST:]
        if _checksum(path, body) != content[:_DIGEST]:
            self.give_up()
            return None
        return _Reader(io.BytesIO(body)).load()

    def save(self, key: Any, data: Any) -> None:
        """Keep ``data`` under ``key``: whole, or not at all. Raises OSError."""
        path, body = self.path(key), dumps(_without_bitcode(data))
        put(path, _checksum(path, body) + body)

    def give_up(self) -> None:
        """Remove the file that was asked for last, and say so."""
        warnings.warn("compiled code in the cache was damaged; it is compiled again", stacklevel=2)
        if self.asked is not None:
            discard(self.asked)

    def flush(self) -> None:
        """Remove all."""
        for path in self.folder.glob(f"{self.base}.*{SUFFIX}"):
            discard(path)


def _checksum(path: Path, body: Any) -> bytes:
    """Of a file's name and content: a whole file of another kernel, put in this one's place, is
    damaged too.
    """
    found = hashlib.blake2b(path.name.encode() + b"\0", digest_size=_DIGEST)
    found.update(body)
    return found.digest()


class _Reader(pickle.Unpickler):
    """Reads kept code without importing those of numba's modules that it was made of, e.g.
    `numba.np.linalg` and with it scipy.

    They are the globals of its environment, which only object mode looks into; what it raises is
    among its constants.
    """

    def find_class(self, module: str, name: str) -> Any:
        found = super().find_class(module, name)
        return _environment if found is getattr(environment, "_rebuild_env", None) else found


def _environment(module: str, constants: Any, name: str) -> Any:
    if (
        module in sys.modules
        or not module.startswith("numba.")
        or environment.lookup_environment(name) is not None
    ):
        return environment._rebuild_env(module, constants, name)
    made = environment.Environment({"__name__": module})
    made.consts[:] = constants
    made.env_name = name
    environment.Environment._memo[name] = made
    return made


def meaning(function: Any) -> bytes:
    """Hash of all that machine code made of ``function`` depends on, but for types and processor:
    the code and the constants of it, of the kernels that it calls and of what makes its intrinsics;
    their options; the versions of what compiles them."""
    digest = hashlib.blake2b(digest_size=16)
    digest.update(_text((FORMAT, numba.__version__, llvmlite.__version__, np.__version__)).encode())
    _add(digest, function, set())
    return digest.digest()


def _add(digest: Any, function: Any, seen: set[Any]) -> None:
    if function in seen:
        return
    seen.add(function)
    code = function.__code__
    kernel = function.__globals__.get(function.__name__)
    options = (
        getattr(kernel, "targetoptions", {}) if getattr(kernel, "py_func", None) is function else {}
    )
    digest.update(
        _text(
            (function.__module__, function.__qualname__, code, function.__defaults__, options)
        ).encode()
    )
    for name in sorted(_names(code) & function.__globals__.keys()):
        value = function.__globals__[name]
        value = getattr(
            value, "py_func", getattr(value, "_defn", value)
        )  # of a kernel, of an intrinsic
        if isinstance(value, FunctionType):
            _add(digest, value, seen)
        elif isinstance(value, np.ndarray):
            digest.update(_text((name, value.dtype.str, value.shape)).encode() + value.tobytes())
        elif isinstance(value, (bool, int, float, complex, str, bytes, tuple, np.generic)):
            digest.update(_text((name, value)).encode())


def _text(value: Any) -> str:
    """`repr` that is the same in every process."""
    if isinstance(value, CodeType):
        return _text((value.co_code, value.co_names, value.co_varnames, value.co_consts))
    if isinstance(value, dict):
        return f"{{{sorted((_text(k), _text(v)) for k, v in value.items())}}}"
    if isinstance(value, (set, frozenset)):
        return f"{{{sorted(map(_text, value))}}}"
    if isinstance(value, (tuple, list)):
        return f"({', '.join(map(_text, value))})"
    return repr(value)


def _names(code: CodeType) -> set[str]:
    """Names that a function and those inside it look up."""
    found = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            found |= _names(constant)
    return found
