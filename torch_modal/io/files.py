"""Atomic writes: a file is whole or absent."""

import contextlib
import logging
import os
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path

logger = logging.getLogger("torch_modal")


@contextlib.contextmanager
def temporary_beside(path: Path, ending: str = ".tmp") -> Iterator[Path]:
    """A temporary name in the same folder; the file of that name is moved to ``path`` at the end.

    Readers, and other processes that write the same file, see the old content or the new one, never a part.

    Args:
        path: Of the final file; its folder must exist.
        ending: Of the temporary name, for libraries that choose a format by it.

    Raises:
        OSError: The folder is missing, full, or not writable; the error names ``path``, not the temporary file. That
            is not left behind.
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


def write_file(path: Path, data: bytes) -> None:
    """Write a whole file or nothing; its folder is made if missing."""
    write_files([(path, data)])


def write_files(files: Iterable[tuple[Path, bytes]]) -> None:
    """Write all files or none: they are moved to their places after the last one was written; folders are made."""
    sizes = {}
    with contextlib.ExitStack() as written:
        for path, data in files:
            path.parent.mkdir(parents=True, exist_ok=True)
            written.enter_context(temporary_beside(path)).write_bytes(data)
            sizes[path] = len(data) / 1000
    for path, size in sizes.items():
        logger.debug("wrote %s, %.1f kB", path, size)
