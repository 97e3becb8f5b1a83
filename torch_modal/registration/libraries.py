"""The optional libraries, each imported when it is first needed."""

from typing import Any

from torch_modal import extras


def require(name: str) -> Any:
    """Import a library of the extra ``register``.

    Raises:
        MissingPackageError: It is not installed; the message says how to install it.
    """
    return extras.require(name, "register", "registration")
