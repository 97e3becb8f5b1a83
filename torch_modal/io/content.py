"""Digests of the contents of objects, as keys of cached results.

Numbers count with their types and shapes, objects with all their attributes, functions and classes with their code and
with whatever it refers to. Libraries count with their versions. Contents that cannot be read have no digest.

joblib.hash and pickles do not serve: they name functions instead of reading their code, and depend on which objects
are shared.
"""

import builtins
import copyreg
import dis
import hashlib
import struct
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, MappingProxyType, MethodType, ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_modal.version import __version__

# Whatever is below these names is known from the version.
_LIBRARIES = {"torch", "numpy", "scipy"}
_OWN = "torch_modal"

# Attributes that Python adds to classes, and those without effect on results.
_NOT_CONTENT = {
    *("__dict__", "__weakref__", "__doc__", "__module__", "__qualname__", "__annotations__", "__annotate__"),
    *("__firstlineno__", "__static_attributes__", "__abstractmethods__", "_abc_impl", "__type_params__"),
    *("__parameters__", "__orig_bases__", "__annotate_func__", "__annotations_cache__"),
}


class ContentError(ValueError):
    """An object has contents that cannot be read, so that it has no digest."""


def content_digest(value: Any) -> str:
    """SHA-256 of all contents of a value, the same in every process.

    Raises:
        ContentError: Some of it cannot be read, such as an open file or a lock.
    """
    try:
        return _Digests().of(value).hex()
    except RecursionError:
        raise ContentError(f"a {type(value).__name__} is nested too deeply to be looked through") from None


def array_digest(array: np.ndarray[Any, Any]) -> bytes:
    """SHA-256 of an array's dtype, shape and numbers.

    Raises:
        ContentError: It holds objects, and not numbers.
    """
    if array.dtype.hasobject:
        raise ContentError(f"an array of {array.dtype} holds references, and not numbers")
    array = np.ascontiguousarray(array)
    numbers = array.reshape(-1).view(np.uint8)
    return _joined("array", [str(array.dtype.descr).encode(), str(array.shape).encode(), numbers])


@cache
def code_digest() -> str:
    """SHA-256 of the package's own code, which changes before its version does."""
    root = Path(__file__).parents[1]
    files = sorted(root.rglob("*.py"))
    parts = [part for file in files for part in (file.relative_to(root).as_posix().encode(), file.read_bytes())]
    return _joined(__version__, parts).hex()


class _Digests:
    """Digests of one value and everything that it refers to."""

    def __init__(self) -> None:
        self.known: dict[int, tuple[Any, bytes]] = {}
        self.open: list[int] = []

    def of(self, value: Any) -> bytes:
        """The digest; for an object that contains itself, its distance above."""
        found = self.known.get(id(value))
        if found is not None:
            return found[1]
        if id(value) in self.open:
            return _joined("above", [str(len(self.open) - self.open.index(id(value))).encode()])
        self.open.append(id(value))
        digest = self._made(value)
        self.open.pop()
        self.known[id(value)] = value, digest  # with the value, whose id would otherwise serve another
        return digest

    def all(self, kind: str, values: Iterable[Any]) -> bytes:
        return _joined(kind, [self.of(value) for value in values])

    def _made(self, value: Any) -> bytes:
        kind = type(value)
        if value is None or value is Ellipsis or value is NotImplemented or kind in (bool, int, str, complex):
            return _joined(kind.__name__, [repr(value).encode("utf-8", "surrogatepass")])
        if kind is float:
            return _joined("float", [struct.pack("<d", value)])
        if kind in (bytes, bytearray):
            return _joined(kind.__name__, [bytes(value)])
        if kind in (list, tuple):
            return self.all(kind.__name__, value)
        if kind in (set, frozenset):
            return _joined(kind.__name__, sorted(self.of(one) for one in value))
        if kind is dict:
            return self.all("dict", (part for pair in value.items() for part in pair))
        if isinstance(value, Tensor):
            return self._of_tensor(value)
        if isinstance(value, (np.ndarray, np.generic)):
            return self.all("objects", value.tolist()) if value.dtype == object else array_digest(np.asarray(value))
        for kinds, digest in self._KINDS:
            if isinstance(value, kinds):
                return digest(self, value)
        return self._of_object(value)

    def _of_tensor(self, value: Tensor) -> bytes:
        plain = value.detach()
        if type(plain) not in (Tensor, torch.nn.Parameter) or plain.layout is not torch.strided or plain.is_meta:
            raise ContentError(f"a {type(value).__name__} of {value.layout} on {value.device} has no plain numbers")
        if torch.func.debug_unwrap(plain, recurse=False) is not plain:
            raise ContentError("a tensor stands for others in a transform of torch.func")
        numbers = plain.cpu().resolve_conj().resolve_neg().contiguous().flatten().view(torch.uint8).numpy()
        return _joined("tensor", [str(value.dtype).encode(), str(tuple(value.shape)).encode(), numbers])

    def _of_code(self, code: CodeType) -> bytes:
        names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars, code.co_flags, code.co_argcount
        counts = code.co_kwonlyargcount, code.co_posonlyargcount, code.co_code, getattr(code, "co_exceptiontable", b"")
        return self.all("code", [sys.version_info[:2], names, counts, code.co_consts])

    def _of_function(self, value: FunctionType) -> bytes:
        if _is_known(value):
            return self._of_name(value)
        cells = [cell.cell_contents for cell in value.__closure__ or () if _is_filled(cell)]
        used = [self._of_global(value.__code__, name, value.__globals__) for name in sorted(_globals(value.__code__))]
        parts = [value.__code__, value.__defaults__, value.__kwdefaults__, cells, vars(value)]
        return _joined("function", [self.of(part) for part in parts] + used)

    def _of_global(self, code: CodeType, name: str, known: dict[str, Any]) -> bytes:
        """A global of a function; of a module, only the attributes that the code may name."""
        if name not in known:
            return _joined("builtin" if hasattr(builtins, name) else "missing", [name.encode()])
        value = known[name]
        if not isinstance(value, ModuleType) or _is_library(value.__name__):
            return self.of(value)
        return self._of_part(value, _attributes(code))

    def _of_part(self, module: ModuleType, names: set[str]) -> bytes:
        """The attributes of a module that have one of these names."""
        digests = [module.__name__.encode()]
        for name in sorted(names & vars(module).keys()):
            value = vars(module)[name]
            inner = isinstance(value, ModuleType) and not _is_library(value.__name__)
            digests += [name.encode(), self._of_part(value, names - {name}) if inner else self.of(value)]
        return _joined("module", digests)

    def _of_module(self, value: ModuleType) -> bytes:
        if _is_library(value.__name__):
            return _joined("library", [value.__name__.encode(), _version(value.__name__).encode()])
        raise ContentError(f"the module {value.__name__} is referred to as a whole")

    def _of_class(self, value: type) -> bytes:
        if _is_known(value):
            return self._of_name(value)
        own = {name: part for name, part in vars(value).items() if name not in _NOT_CONTENT}
        for name, part in list(own.items()):
            if type(part).__name__ in ("member_descriptor", "getset_descriptor"):  # a slot, known by its name
                own[name] = None
        return self.all("class", [value.__qualname__, type(value), value.__bases__, own])

    def _of_wrapped(self, value: Any) -> bytes:
        return self.all(type(value).__name__, [value.__func__, getattr(value, "__self__", None)])

    def _of_name(self, value: Any) -> bytes:
        """Something of a library, or of Python."""
        module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
        if module is None and isinstance(getattr(value, "__self__", None), ModuleType):
            module = value.__self__.__name__
        if not isinstance(module, str) or not isinstance(name, str) or not _is_library(module):
            raise ContentError(f"the code of {name or value!r} cannot be read")
        return _joined("name", [module.encode(), name.encode(), _version(module).encode()])

    def _of_builtin(self, value: Any) -> bytes:
        own = getattr(value, "__self__", None)
        if own is None or isinstance(own, (ModuleType, type)):
            return self._of_name(value)
        return self.all("bound", [own, value.__name__])

    def _of_object(self, value: Any) -> bytes:
        """What pickle would write: the class, and all attributes of the instance."""
        if hasattr(value, "__wrapped__"):  # such as functools.cache
            return self.all("wrapper", [type(value), value.__wrapped__])
        if isinstance(value, torch.nn.Module):
            return self.all("object", [type(value), vars(value)])
        try:
            reduce = copyreg.dispatch_table.get(type(value))
            reduced = reduce(value) if reduce else value.__reduce_ex__(4)
        except Exception as error:
            raise ContentError(f"a {type(value).__qualname__} has no content that can be read: {error}") from error
        if isinstance(reduced, str):
            if not _is_library(type(value).__module__):
                raise ContentError(f"{reduced} is known by its name only")
            return self.all("named", [type(value), reduced])
        return self.all("object", [list(part) if isinstance(part, Iterator) else part for part in reduced])

    _KINDS: tuple[tuple[Any, Callable[["_Digests", Any], bytes]], ...] = (
        (type, _of_class),
        (FunctionType, _of_function),
        (CodeType, _of_code),
        (ModuleType, _of_module),
        ((MethodType, staticmethod, classmethod), _of_wrapped),
        (MappingProxyType, lambda self, value: self.of(dict(value))),
        (property, lambda self, value: self.all("property", [value.fget, value.fset, value.fdel])),
        (cached_property, lambda self, value: self.all("cached_property", [value.func, value.attrname])),
        (BuiltinFunctionType, _of_builtin),
    )


def _joined(kind: str, parts: Iterable[Any]) -> bytes:
    total = hashlib.sha256(kind.encode())
    for part in parts:
        total.update(struct.pack("<q", part.nbytes if isinstance(part, np.ndarray) else len(part)))
        total.update(part)
    return total.digest()


def _is_filled(cell: Any) -> bool:
    try:
        return cell.cell_contents is not cell
    except ValueError:
        return False


def _globals(code: CodeType) -> set[str]:
    """Names of the module that a function, and those inside it, read."""
    found = {one.argval for one in dis.get_instructions(code) if one.opname in ("LOAD_GLOBAL", "LOAD_NAME")}
    return found.union(*(_globals(inner) for inner in code.co_consts if isinstance(inner, CodeType)))


def _attributes(code: CodeType) -> set[str]:
    """Names of attributes that a function, and those inside it, may read."""
    return set(code.co_names).union(*(_attributes(inner) for inner in code.co_consts if isinstance(inner, CodeType)))


def _is_library(module: str | None) -> bool:
    top = (module or "").partition(".")[0]
    if top not in sys.stdlib_module_names:
        return top in _LIBRARIES or top == _OWN
    file = getattr(sys.modules.get(top), "__file__", None)  # somebody's own may have the name of one of Python's
    return file is None or Path(file).is_relative_to(Path(copyreg.__file__).parent)


def _is_known(value: Any) -> bool:
    """Whether a class or function is the one of that name in a library."""
    if not _is_library(value.__module__):
        return False
    found: Any = sys.modules.get(value.__module__)
    for name in value.__qualname__.split("."):
        found = getattr(found, name, None)
    return found is value


@cache
def _version(module: str) -> str:
    top = module.partition(".")[0]
    if top == _OWN:
        return code_digest()
    if top in sys.stdlib_module_names:
        return sys.version
    try:
        return version(top)
    except PackageNotFoundError:
        return str(getattr(sys.modules.get(top), "__version__", ""))
