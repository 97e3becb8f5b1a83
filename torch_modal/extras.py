"""Lazy imports of optional packages."""

import importlib
import importlib.util
from collections.abc import Collection
from typing import Any

from torch_modal.errors import MissingPackageError


def require(module: str, extra: str, what: str) -> Any:
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
        raise _missing([module], extra, what) from error


def require_installed(modules: Collection[str], extra: str, what: str) -> None:
    """Raise before the work begins if optional packages are missing, without importing them.

    Raises:
        MissingPackageError: Packages are not installed.
    """
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        raise _missing(missing, extra, what)


def _missing(modules: list[str], extra: str, what: str) -> MissingPackageError:
    are = "is" if len(modules) == 1 else "are"
    return MissingPackageError(
        f"{what} needs {' and '.join(modules)}, which {are} not installed: pip install 'torch_modal[{extra}]'"
    )
