"""Atomic writes, after which a file is whole or absent, and reads of the files that a mesh file names."""

import contextlib
import csv
import io
import os
import uuid
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from torch_modal.errors import MeshWarning

LARGEST_COMPANION = 2**30  # bytes


@contextlib.contextmanager
def atomic_write(path: Path, ending: str = ".tmp") -> Iterator[Path]:
    """Name of a temporary file in the folder of ``path``, which must exist; the file is moved to ``path`` at the end.

    Readers, and other processes that write the same file, see the old content or the new one, never a part. An OSError
    names ``path``, not the temporary file, which is not left behind. Some libraries choose a format by the ending.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{uuid.uuid4().hex[:8]}{ending}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.errno is None or (error.filename is not None and Path(error.filename) != temporary):
            raise
        # The caller knows the final name only.
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def read_companion(document: Path, name: str, most: int = LARGEST_COMPANION) -> tuple[str, bytes]:
    """Read a file that a mesh file names; returns its path below the folder of the mesh file, and its content.

    Raises:
        ValueError: It does not exist, lies outside that folder, is not regular, or is larger than ``most`` bytes.
    """
    folder, shown = document.parent.resolve(), f"{name[:100]!r} is not "
    try:
        path = (folder / name).resolve(strict=True)
        size = path.stat().st_size
    except (OSError, RuntimeError, ValueError):  # also loops of links, and names that are too long or have a null
        raise ValueError(f"{shown}there") from None
    if not path.is_relative_to(folder):
        raise ValueError(f"{shown}read, as it lies outside the folder of {document.name}; move it there")
    if not path.is_file() or size > most:
        raise ValueError(f"{shown}read, as it is no file, or larger than {most} bytes")
    return path.relative_to(folder).as_posix(), path.read_bytes()


def try_companion(document: Path, name: str, what: str, most: int = LARGEST_COMPANION) -> tuple[str, bytes] | None:
    """Call :func:`read_companion`; if it fails, warn that the document is used without that file, and return None."""
    try:
        return read_companion(document, name, most)
    except ValueError as error:
        warnings.warn(f"{document.name} is without {what}: {error}", MeshWarning, stacklevel=6)
    return None


def csv_bytes(rows: Iterable[Sequence[object]]) -> bytes:
    """A table as a CSV file, of which the first row names the columns."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return stream.getvalue().encode("utf-8")


def write_files(files: Iterable[tuple[Path, bytes]]) -> None:
    """Write all files or none: they are moved to their places after the last one was written; folders are made."""
    with contextlib.ExitStack() as written:
        for path, data in files:
            path.parent.mkdir(parents=True, exist_ok=True)
            written.enter_context(atomic_write(path)).write_bytes(data)
