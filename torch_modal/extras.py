"""Lazy imports of optional packages."""

import importlib
from types import ModuleType

from torch_modal.errors import MissingPackageError


def require(module: str, extra: str, what: str) -> ModuleType:
    """Import an optional package.

    Args:
        module: Name of the module.
        extra: The extra that installs it: ``pip install 'torch_modal[extra]'``.
        what: The feature that needs it, for the message.

    Raises:
        MissingPackageError: The package is not installed; the message says how to install it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        message = f"{what} needs {module}, which is not installed: pip install 'torch_modal[{extra}]'"
        raise MissingPackageError(message) from error
