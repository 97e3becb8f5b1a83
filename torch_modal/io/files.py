"""Files that are either whole or absent."""

import contextlib
import os
import uuid
from pathlib import Path


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file under a temporary name in the same folder, then move it to its place.

    Readers, and other processes that write the same file, see the old content or the new one, never a part.

    Args:
        path: Where the file goes; its folder must exist.
        data: The whole content.

    Raises:
        OSError: The folder is missing, full, or not writable. No temporary file is left behind.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{uuid.uuid4().hex[:8]}.tmp")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
