"""Packages that are imported when they are needed: some of them belong to an extra of this one."""

import gc
import importlib
import importlib.util
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Any

from torch_modal.errors import MissingPackageError


@contextmanager
def uncollected() -> Iterator[None]:
    """No search for garbage inside: imports leave next to none, and a search goes through all that torch is made of.

    That is a tenth of a second for each, and large packages bring it about once or twice. What they have made counts as
    old afterwards, or the next searches, of what is young, would go through all of it.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            # Python 3.12 starts with a few hundred frozen. What others froze, which is all that they had, stays so.
            if gc.get_freeze_count() < 1000:
                gc.freeze()
                gc.unfreeze()
            gc.enable()


def require(module: str, extra: str, what: str) -> Any:
    """Import an optional package.

    Args:
        module: Its name.
        extra: What brings it: ``pip install 'torch_modal[extra]'``.
        what: What needs it, as the message begins.

    Raises:
        MissingPackageError: It is not installed; the message says how to install it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise _missing([module], extra, what) from error


def require_installed(modules: Collection[str], extra: str, what: str) -> None:
    """Refuse work that needs optional packages before any of it is done; nothing is imported.

    Raises:
        MissingPackageError: It names those that are not installed.
    """
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        raise _missing(missing, extra, what)


def _missing(modules: list[str], extra: str, what: str) -> MissingPackageError:
    are = "is" if len(modules) == 1 else "are"
    return MissingPackageError(
        f"{what} needs {' and '.join(modules)}, which {are} not installed: pip install 'torch_modal[{extra}]'"
    )
