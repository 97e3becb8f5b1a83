"""Safetensors files of the package: a format with a version, and digests that find damage before numbers are used.

The metadata have one entry, ``torch_modal``, which is JSON: the format, its version, and what a caller adds.
(safetensors does not keep the order of several entries, and equal content gives equal bytes.) The tensor ``digests``
has a row of SHA-256 for the header and for each other tensor, in the order of their names. The first row covers the
others, so that opening a large file does not read its numbers; each tensor is compared with its row when it is read.
"""

import contextlib
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from torch_modal.autograd import outside_inference_mode
from torch_modal.io.files import atomic_write

DIGESTS = "digests"
ENTRY = "torch_modal"


def write_tensors(
    path: Path, format: str, version: str, tensors: Mapping[str, Tensor], metadata: Mapping[str, object] | None = None
) -> None:
    """Write a whole file or nothing, into a folder that exists. JSON must be able to hold the metadata."""
    header = json.dumps({"format": format, "version": version, **(metadata or {})}, sort_keys=True)
    # Copies, as safetensors refuses tensors that share memory.
    copies = {
        name: tensor.detach().cpu().clone(memory_format=torch.contiguous_format) for name, tensor in tensors.items()
    }
    rows = [_digest(name, copies[name]) for name in sorted(copies)]
    table = bytearray(b"".join([_header_digest(header, sorted(copies), rows), *rows]))
    copies[DIGESTS] = torch.frombuffer(table, dtype=torch.uint8).reshape(-1, 32)
    # Not safetensors' save_file: its files can be read by their owner alone, whatever the umask says.
    with atomic_write(path) as temporary:
        temporary.write_bytes(save(copies, {ENTRY: header}))


class TensorFile:
    """A file that is open for reading and mapped into memory: tensors are read when they are used, and outlive it.

    Raises a ValueError if it is damaged, or lacks the format, the version or the tensors that are named.
    """

    def __init__(self, path: Path, format: str, version: str, needs: Sequence[str] = ()) -> None:
        if not path.is_file():
            raise FileNotFoundError(f"there is no file {path}")
        self.path = path
        try:
            self._file = safe_open(path, framework="pt", device="cpu")
            header = (self._file.metadata() or {}).get(ENTRY, "")
            names = sorted(self._file.keys())
            digests = bytes_of(self._file.get_tensor(DIGESTS)) if DIGESTS in names else b""
        except SafetensorError as error:
            raise ValueError(f"{path} is no safetensors file, or a damaged one: {error}") from error
        except RuntimeError as error:  # of torch, which opens the file a second time: another process may be quicker
            raise OSError(f"{path} cannot be opened: {error}") from error
        try:
            self.metadata: dict[str, Any] = dict(json.loads(header))  # with what the writer added
        except (TypeError, ValueError, RecursionError):  # not of this package
            self.metadata = {}
        written = {key: self.metadata.get(key) for key in ("format", "version")}
        if written != {"format": format, "version": version}:
            raise ValueError(f"{path} holds no {format} of version {version!r}, but {written}; make the file again")
        names = [name for name in names if name != DIGESTS]
        if missing := [name for name in needs if name not in names]:
            raise ValueError(f"{path} lacks the tensors {', '.join(missing[:4])}; make the file again")
        rows = [digests[i : i + 32] for i in range(32, len(digests), 32)]
        if len(rows) != len(names) or digests[:32] != _header_digest(header, names, rows):
            raise ValueError(f"{path} is damaged: its metadata and digests are not what was written")
        self._digests = dict(zip(names, rows, strict=True))
        self.shapes = {name: tuple(self._file.get_slice(name).get_shape()) for name in names}

    @outside_inference_mode
    def tensor(self, name: str) -> Tensor:
        """One of the tensors; raises ValueError if it is not what was written."""
        tensor: Tensor = self._file.get_tensor(name)
        if self._digests[name] != _digest(name, tensor):
            raise ValueError(f"{self.path} is damaged: its tensor {name!r} is not what was written")
        return tensor

    @outside_inference_mode
    def tensors(self) -> dict[str, Tensor]:
        """Copies of all tensors, which do not depend on the file."""
        return {name: self.tensor(name).clone() for name in self.shapes}


def read_tensors(path: Path, format: str, version: str, metadata: Mapping[str, object]) -> dict[str, Tensor] | None:
    """Memory-mapped tensors of a file; None if it is missing or damaged, or has other metadata."""
    with contextlib.suppress(OSError, ValueError):
        file = TensorFile(path, format, version)
        if file.metadata == {"format": format, "version": version, **metadata}:
            return {name: file.tensor(name) for name in file.shapes}
    return None


def _digest(name: str, tensor: Tensor) -> bytes:
    total = hashlib.sha256(json.dumps([name, str(tensor.dtype), list(tensor.shape)]).encode())
    total.update(bytes_of(tensor))
    return total.digest()


def bytes_of(tensor: Tensor) -> bytes:
    """The numbers of a tensor in main memory."""
    return tensor.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()


def _header_digest(header: str, names: Sequence[str], rows: Sequence[bytes]) -> bytes:
    return hashlib.sha256(json.dumps([header, list(names)]).encode() + b"".join(rows)).digest()
