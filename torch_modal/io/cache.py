"""Results of long computations on disk, named by the hash of their inputs."""

import contextlib
import hashlib
import json
import os
import re
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from torch_modal.io.files import write_atomically

CACHE_VERSION = 5
"""Part of every key: raise it when the algorithm of cached results changes."""
CACHE_VARIABLE = "TORCH_MODAL_CACHE"
LIMIT_VARIABLE = "TORCH_MODAL_CACHE_LIMIT"
DEFAULT_LIMIT = 4 * 2**30
KEPT_PART = 0.9
"""Share of the limit that is left after entries were removed, so that not each new entry removes others."""
ABANDONED = 3600.0
"""Seconds after which a partial file belongs to no running process."""
SUFFIX = ".safetensors"
_DIGEST = "digest"
_OWN_NAME = re.compile(r"[a-z]+-[0-9a-f]{64}\.safetensors|\.[a-z]+-[0-9a-f]{64}\.safetensors\..+\.tmp")

Arrays = dict[str, NDArray[Any]]


class CacheWarning(UserWarning):
    """The cache cannot be written: results are right, but will be computed again."""


def default_cache_dir() -> Path:
    """The folder named by ``TORCH_MODAL_CACHE``, or ``torch_modal`` in the user's cache folder."""
    if named := os.environ.get(CACHE_VARIABLE):
        return Path(named).expanduser()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "torch_modal"


def size_limit() -> int:
    """The largest size of a cache folder in bytes: ``TORCH_MODAL_CACHE_LIMIT``, or 4 GiB.

    Raises:
        ValueError: The variable is no size.
    """
    named = os.environ.get(LIMIT_VARIABLE)
    try:
        return parse_size(named) if named else DEFAULT_LIMIT
    except ValueError as error:
        raise ValueError(f"the environment variable {LIMIT_VARIABLE}: {error}") from None


def parse_size(text: str) -> int:
    """Bytes of ``"500M"``, ``"4G"`` or ``"1.5 GiB"``; all units are powers of 1,024.

    Raises:
        ValueError: It is no size.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?) ?(?:([KMGT])(?:i?B)?|B)?", text.strip(), re.IGNORECASE)
    if match is None:
        raise ValueError(f"{text!r} is no size; give a number of bytes, or something like 500M or 4G")
    number, unit = match.groups()
    return int(float(number) * 1024 ** (" KMGT".index((unit or " ").upper())))


@dataclass(frozen=True)
class Cache:
    """A folder of safetensors files, one per result, each with a digest that every read verifies.

    Damaged, truncated or foreign entries are computed again and replaced. Several processes may share the
    folder: entries are moved into place whole. When they take more than the limit, the least recently used are
    removed.

    Attributes:
        folder: Of the entries; it is made when the first is written. None: nothing is cached.
        limit: Largest size of all entries, in bytes. A single entry may be larger.
    """

    folder: Path | None
    limit: int = DEFAULT_LIMIT

    @classmethod
    def at(cls, cache_dir: str | os.PathLike[str] | None = None, *, enabled: bool = True) -> "Cache":
        """The cache in a folder, by default in :func:`default_cache_dir`, or a disabled one.

        Raises:
            ValueError: ``TORCH_MODAL_CACHE_LIMIT`` is no size.
        """
        if not enabled:
            return cls(None)
        return cls(default_cache_dir() if cache_dir is None else Path(cache_dir).expanduser(), size_limit())

    def get(
        self,
        kind: str,
        inputs: Mapping[str, NDArray[Any]],
        parameters: Mapping[str, Any],
        compute: Callable[[], Mapping[str, NDArray[Any]]],
    ) -> Arrays:
        """The cached result; computed and cached if there is none.

        Args:
            kind: Of result; the first part of the file's name.
            inputs: Arrays that the result depends on.
            parameters: Numbers and strings that it depends on.
            compute: Computes the result.

        Returns:
            The arrays that ``compute`` returned, now or earlier.

        Warns:
            CacheWarning: The folder cannot be written.
        """
        kept = self.find(kind, inputs, parameters)
        return self.keep(kind, inputs, parameters, compute()) if kept is None else kept

    def find(self, kind: str, inputs: Mapping[str, NDArray[Any]], parameters: Mapping[str, Any]) -> Arrays | None:
        """The cached result, if there is one; arguments as for :meth:`get`."""
        if self.folder is None:
            return None
        path = self._path(self.folder, kind, inputs, parameters)
        if (found := _read(path)) is not None:
            with contextlib.suppress(OSError):  # removed meanwhile, or not writable
                os.utime(path)  # the time of the last use
        return found

    def keep(
        self,
        kind: str,
        inputs: Mapping[str, NDArray[Any]],
        parameters: Mapping[str, Any],
        result: Mapping[str, NDArray[Any]],
    ) -> Arrays:
        """Write a result, in place of any earlier one; arguments as for :meth:`get`.

        Returns:
            The arrays of the result.

        Warns:
            CacheWarning: The folder cannot be written.
        """
        if self.folder is None:
            return dict(result)
        arrays = {name: np.ascontiguousarray(array) for name, array in result.items()}
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            path = self._path(self.folder, kind, inputs, parameters)
            write_atomically(path, save_arrays({**arrays, _DIGEST: _digest(arrays)}))
            _make_room(self.folder, self.limit, path)
        except OSError as error:
            warnings.warn(
                f"cannot keep {kind} in the cache folder {self.folder} ({error}); set {CACHE_VARIABLE} or "
                "cache_dir to a folder that can be written",
                CacheWarning,
                stacklevel=3,
            )
        return arrays

    @staticmethod
    def _path(folder: Path, kind: str, inputs: Mapping[str, NDArray[Any]], parameters: Mapping[str, Any]) -> Path:
        return folder / f"{kind}-{content_key(kind, inputs, parameters)}{SUFFIX}"


class CacheContent(NamedTuple):
    """Size of a cache folder."""

    n_entries: int
    n_bytes: int


def cache_content(cache_dir: str | os.PathLike[str] | None = None) -> CacheContent:
    """Number of entries in a cache folder and their size; none if there is no such folder.

    Args:
        cache_dir: The folder, by default :func:`default_cache_dir`.
    """
    entries = _entries(cache_dir)
    return CacheContent(len(entries), sum(entry.size for entry in entries))


def clear_cache(cache_dir: str | os.PathLike[str] | None = None) -> CacheContent:
    """Remove the entries of a cache folder, and partial files of killed processes. Other files stay.

    Other processes recompute what they miss.

    Args:
        cache_dir: The folder, by default :func:`default_cache_dir`.

    Returns:
        The entries removed.

    Raises:
        OSError: An entry cannot be removed.
    """
    return _remove(_entries(cache_dir))


def shrink_cache(limit: int, cache_dir: str | os.PathLike[str] | None = None) -> CacheContent:
    """Remove the entries that were not used for the longest, until the others take no more than a limit.

    Args:
        limit: In bytes.
        cache_dir: The folder, by default :func:`default_cache_dir`.

    Returns:
        The entries removed.

    Raises:
        OSError: An entry cannot be removed.
    """
    return _remove(_oldest(_entries(cache_dir), limit))


class _Entry(NamedTuple):
    used: int
    """Time of the last use, in nanoseconds."""
    size: int
    path: Path


def _entries(cache_dir: str | os.PathLike[str] | None) -> list[_Entry]:
    """Entries and partial ones, known by their names; a user's own files may lie beside them. The oldest come first."""
    folder = default_cache_dir() if cache_dir is None else Path(cache_dir).expanduser()
    found = []
    for path in folder.iterdir() if folder.is_dir() else ():
        if _OWN_NAME.fullmatch(path.name):
            with contextlib.suppress(FileNotFoundError):  # another process may be clearing
                status = path.stat()
                found.append(_Entry(status.st_mtime_ns, status.st_size, path))
    return sorted(found)


def _make_room(folder: Path, limit: int, newest: Path) -> None:
    """Remove the oldest entries if all together are too large; the newest stays in any case."""
    entries = _entries(folder)
    others = [entry for entry in entries if entry.path != newest]
    size = sum(entry.size for entry in entries if entry.path == newest)
    if _oldest(others, limit - size):
        for entry in _oldest(others, int(KEPT_PART * limit) - size):
            with contextlib.suppress(OSError):  # another process removed it, or has it open
                entry.path.unlink()


def _oldest(entries: list[_Entry], limit: int) -> list[_Entry]:
    """Which entries to remove so that the rest takes no more than a limit: those not used for the longest."""
    now, total, chosen = time.time(), sum(entry.size for entry in entries), []
    for entry in entries:
        if entry.path.suffix != SUFFIX and now - entry.used / 1e9 < ABANDONED:
            continue  # another process is writing it
        if total <= limit:
            break
        chosen.append(entry)
        total -= entry.size
    return chosen


def _remove(entries: list[_Entry]) -> CacheContent:
    """Remove entries; returns how many there were."""
    sizes = []
    for entry in entries:
        with contextlib.suppress(FileNotFoundError):
            entry.path.unlink()
            sizes.append(entry.size)
    return CacheContent(len(sizes), sum(sizes))


def content_key(kind: str, inputs: Mapping[str, NDArray[Any]], parameters: Mapping[str, Any]) -> str:
    """SHA-256 of the kind, the arrays (bytes, shapes, dtypes), the parameters and the cache version."""
    head = json.dumps([CACHE_VERSION, kind, dict(parameters)], sort_keys=True)
    return hashlib.sha256(head.encode() + _digest(inputs).tobytes()).hexdigest()


def _digest(arrays: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
    """SHA-256 of named arrays. *Shape:* ``(32,)``."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        if array.dtype.hasobject or array.dtype.names:
            raise ValueError(f"{name} is an array of {array.dtype}; a key is made of numbers")
        total.update(json.dumps([name, array.dtype.str, list(array.shape)]).encode())
        total.update(array.tobytes())
    return np.frombuffer(total.digest(), dtype=np.uint8).copy()


def _read(path: Path) -> Arrays | None:
    """The entry's arrays if the file is there, can be parsed, and has the digest it was written with."""
    try:
        arrays = load_arrays(path.read_bytes())
    except (OSError, SafetensorError, KeyError, ValueError):
        # Any damaged file is computed again.
        return None
    written = arrays.pop(_DIGEST, None)
    return arrays if written is not None and np.array_equal(written, _digest(arrays)) else None
