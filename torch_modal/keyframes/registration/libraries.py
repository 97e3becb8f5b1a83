"""The optional libraries, each imported when it is first needed."""

import importlib
from typing import Any

from torch_modal.errors import MissingPackageError


def require(name: str) -> Any:
    """Import a library of the extra ``register``.

    Raises:
        MissingPackageError: It is not installed; the message says how to install it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingPackageError(
            f"registration needs {name}, which is not installed: pip install 'torch_modal[register]'"
        ) from error
