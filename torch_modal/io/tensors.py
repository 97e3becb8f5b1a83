"""Safetensors files with digests: damage is found before any number of a file is used.

The tensor ``digests`` has a row of SHA-256 for the metadata and for each other tensor, in the order of their names. The
first row covers the others, so that the header of a large file is checked without reading its numbers, and each tensor
when it is read. Files without it, which earlier versions wrote, are read unchecked.
"""

import contextlib
import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load, save
from torch import Tensor

DIGESTS = "digests"

# What safetensors raises for damaged files; its own error is no ValueError.
_DAMAGED = (SafetensorError, ValueError, TypeError, KeyError, OverflowError, RuntimeError)


def to_bytes(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> bytes:
    """A file of tensors on the CPU, with their digests."""
    parts = {name: tensor.contiguous() for name, tensor in tensors.items()}
    rows = [_digest(name, parts[name]) for name in sorted(parts)]
    table = bytearray(b"".join([_head_digest(metadata, sorted(parts), rows), *rows]))
    return save({**parts, DIGESTS: torch.frombuffer(table, dtype=torch.uint8).reshape(-1, 32)}, dict(metadata))


def from_bytes(data: bytes, path: Path | str, kind: str = "safetensors") -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors and the metadata of a file, checked.

    Args:
        data: The whole content.
        path: Where it is from, for messages.
        kind: What the file should be, for messages.

    Raises:
        ValueError: It is damaged, or another file.
    """
    try:
        tensors = load(data)
        size = int.from_bytes(data[:8], "little")
        metadata = json.loads(data[8 : 8 + size]).get("__metadata__", {})
    except _DAMAGED as error:
        raise ValueError(f"{path} is no {kind} file, or a damaged one: {error}") from error
    if (digests := tensors.pop(DIGESTS, None)) is not None:
        known = _checked(digests, metadata, list(tensors), path)
        for name, tensor in tensors.items():
            _check(known, name, tensor, path)
    return tensors, metadata


class TensorFile:
    """A file that is mapped into memory, with checked metadata.

    Attributes:
        metadata: Of the file.
        shapes: Of its tensors, without their digests.
    """

    def __init__(self, file: Any, path: Path) -> None:
        self._file, self._path = file, path
        self.metadata: dict[str, str] = file.metadata() or {}
        names = sorted(set(file.keys()) - {DIGESTS})
        self.shapes = {name: tuple(file.get_slice(name).get_shape()) for name in names}
        digests = file.get_tensor(DIGESTS) if DIGESTS in set(file.keys()) else None
        self._digests = None if digests is None else _checked(digests, self.metadata, names, path)

    def tensor(self, name: str) -> Tensor:
        """One of them, checked; the mapping outlives the file.

        Raises:
            ValueError: It is not what was written.
        """
        found: Tensor = self._file.get_tensor(name)
        if self._digests is not None:
            _check(self._digests, name, found, self._path)
        return found


@contextlib.contextmanager
def opened(path: Path) -> Iterator[TensorFile]:
    """A file for reading.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, or no safetensors file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            yield TensorFile(file, path)
    except SafetensorError as error:
        raise ValueError(f"{path} is no safetensors file, or a damaged one: {error}") from error


def _digest(name: str, tensor: Tensor) -> bytes:
    total = hashlib.sha256(json.dumps([name, str(tensor.dtype), list(tensor.shape)]).encode())
    total.update(tensor.detach().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return total.digest()


def _head_digest(metadata: Mapping[str, str], names: list[str], rows: list[bytes]) -> bytes:
    return hashlib.sha256(json.dumps([sorted(metadata.items()), names]).encode() + b"".join(rows)).digest()


def _checked(digests: Tensor, metadata: Mapping[str, str], names: list[str], path: Path | str) -> dict[str, bytes]:
    """The digest of each tensor, if the metadata and these are what was written."""
    table, names = digests.reshape(-1).view(torch.uint8).numpy().tobytes(), sorted(names)
    first, *rows = (table[i : i + 32] for i in range(0, len(table), 32)) if table else [b""]
    if len(rows) != len(names) or first != _head_digest(metadata, names, rows):
        raise ValueError(f"{path} is damaged: its metadata and digests are not what was written")
    return dict(zip(names, rows, strict=True))


def _check(known: Mapping[str, bytes], name: str, tensor: Tensor, path: Path | str) -> None:
    if known[name] != _digest(name, tensor):
        raise ValueError(f"{path} is damaged: its tensor {name!r} is not what was written")
