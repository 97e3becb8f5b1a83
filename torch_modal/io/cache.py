"""Results of long computations on disk, named by a digest of everything that they depend on."""

import contextlib
import hashlib
import os
import re
import struct
import sys
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import AnyArray
from torch_modal.io.tensors import bytes_of, read_tensors, write_tensors

CACHE_VERSION = 7  # part of every key: raise it when the algorithm of cached results changes
CACHE_VARIABLE = "TORCH_MODAL_CACHE"
LIMIT_VARIABLE = "TORCH_MODAL_CACHE_LIMIT"
DEFAULT_LIMIT = 4 * 2**30
FORMAT = "torch_modal.cache"
SUFFIX = ".safetensors"
_ENTRY_NAME = re.compile(r"[a-z]+-[0-9a-f]{64}\.safetensors")

Arrays = dict[str, AnyArray]


class CacheWarning(UserWarning):
    """The cache cannot be written: results are right, but are computed again next time."""


class ContentError(ValueError):
    """An object has no digest, as its contents are not plain data."""


@dataclass(frozen=True)
class Cache:
    """A folder of files, one per result, each with digests that every read verifies.

    Damaged or foreign entries are computed again and replaced. Several processes may share the folder: entries are
    moved into place whole. When they take more than the limit, the least recently used are removed.
    """

    folder: Path | None  # made when the first entry is written; with None nothing is cached
    limit: float = DEFAULT_LIMIT  # bytes of all entries; a single one may be larger

    @classmethod
    def at(cls, cache_dir: str | os.PathLike[str] | None = None, *, enabled: bool = True) -> "Cache":
        """The cache in a folder, or a disabled one.

        The default is ``TORCH_MODAL_CACHE``, or ``torch_modal`` in the user's cache folder. The limit is
        ``TORCH_MODAL_CACHE_LIMIT``, in bytes, or 4 GiB.
        """
        if not enabled:
            return cls(None)
        users = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
        folder = cache_dir or os.environ.get(CACHE_VARIABLE) or os.path.join(users, "torch_modal")
        limit = os.environ.get(LIMIT_VARIABLE) or DEFAULT_LIMIT
        try:
            return cls(Path(folder).expanduser(), float(limit))
        except ValueError:
            raise ValueError(f"the environment variable {LIMIT_VARIABLE} is a number of bytes, got {limit!r}") from None

    def get(
        self,
        kind: str,
        inputs: Mapping[str, AnyArray],
        parameters: Mapping[str, object],
        compute: Callable[[], Mapping[str, AnyArray]],
    ) -> Arrays:
        """Look up a result by its kind, input arrays and parameters (numbers, strings); compute it if it is missing."""
        if self.folder is None:
            return dict(compute())
        path = self.folder / entry_name(kind, inputs, parameters)
        if (stored := read_tensors(path, FORMAT, str(CACHE_VERSION), {"entry": path.name})) is not None:
            with contextlib.suppress(OSError):  # removed meanwhile, or not writable
                os.utime(path)  # the time of the last use
            return {name: tensor.numpy().copy() for name, tensor in stored.items()}  # entries may be removed
        result = compute()
        tensors = {name: torch.from_numpy(np.array(array)) for name, array in result.items()}
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_tensors(path, FORMAT, str(CACHE_VERSION), tensors, {"entry": path.name})
            self._make_room(path)
        except OSError as error:
            warnings.warn(
                f"cannot keep {kind} in the cache folder {self.folder} ({error}); set {CACHE_VARIABLE} or "
                "cache_dir to a folder that can be written",
                CacheWarning,
                stacklevel=2,
            )
        return dict(result)

    def _make_room(self, newest: Path) -> None:
        """Remove the entries that were not used for the longest time, if all take too much; the newest one stays.

        Entries are known by their names: the user's own files in the folder stay.
        """
        entries = []
        for path in newest.parent.iterdir():
            if _ENTRY_NAME.fullmatch(path.name):
                with contextlib.suppress(FileNotFoundError):  # another process removed it
                    entries.append((path == newest, path.stat().st_mtime_ns, path.stat().st_size, path))
        room = self.limit
        for is_newest, _, size, path in sorted(entries, reverse=True):
            room -= size
            if room < 0 and not is_newest:
                with contextlib.suppress(OSError):  # another process removed it, or has it open
                    path.unlink()


def entry_name(kind: str, inputs: Mapping[str, AnyArray], parameters: Mapping[str, object]) -> str:
    """File name of a result: its kind, and a digest of its inputs and the version of the cache."""
    key = content_digest([CACHE_VERSION, kind, sorted(inputs.items()), sorted(parameters.items())])
    return f"{kind}-{key}{SUFFIX}"


# ----------------------------------------------------------------------------------------------------------- digests
def content_digest(value: object) -> str:
    """SHA-256 of all contents of a value, the same in every process.

    It includes types and shapes of numbers, and classes and all attributes of objects of this package. Other objects
    raise a :class:`ContentError`: results would depend on code that has no digest.
    """
    try:
        return _digest(value).hex()
    except RecursionError:
        raise ContentError(f"a {type(value).__name__} is nested too deeply") from None


def _digest(value: Any) -> bytes:
    kind = type(value)
    if value is None or kind in (bool, int, float, str):
        return _hash_items(kind.__name__, [repr(value).encode("utf-8", "surrogatepass")])
    if kind in (list, tuple, dict, OrderedDict, set, frozenset):
        digests = map(_digest, chain(*value.items()) if isinstance(value, dict) else value)
        return _hash_items(kind.__name__, sorted(digests) if isinstance(value, (set, frozenset)) else digests)
    if kind in (Tensor, torch.nn.Parameter):
        x = value.detach()
        if x.layout is not torch.strided or x.is_meta or torch.func.debug_unwrap(x, recurse=False) is not x:
            raise ContentError(
                f"a tensor of {x.layout} on {x.device}, or inside a transform of torch.func, has no numbers"
            )
        numbers = bytes_of(x.cpu().resolve_conj().resolve_neg())
        return _hash_items("tensor", [str(x.dtype).encode(), str(tuple(x.shape)).encode(), numbers])
    if isinstance(value, (np.ndarray, np.generic)) and not value.dtype.hasobject:
        return _hash_items("array", [str(value.dtype.descr).encode(), str(value.shape).encode(), value.tobytes()])
    # Only classes that this package defines, under the name by which they are found there.
    named: Any = sys.modules.get(kind.__module__) if kind.__module__.startswith("torch_modal.") else None
    for name in kind.__qualname__.split("."):
        named = getattr(named, name, None)
    if named is kind:
        content = tuple(value) if isinstance(value, tuple) else dict(vars(value))
        return _hash_items(f"{kind.__module__}.{kind.__qualname__}", [_digest(content)])
    raise ContentError(f"a {kind.__qualname__} is neither plain data nor of a class of torch_modal")


def _hash_items(kind: str, chunks: Iterable[bytes]) -> bytes:
    total = hashlib.sha256(kind.encode())
    for chunk in chunks:
        total.update(struct.pack("<q", len(chunk)))
        total.update(chunk)
    return total.digest()
