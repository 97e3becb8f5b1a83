"""The backends by name, and the choice among them."""

from collections.abc import Callable

from torch_modal.elastic.backend import TorchBackend
from torch_modal.elastic.warp_backend import WarpBackend

BACKENDS: dict[str, Callable[[], TorchBackend]] = {"torch": TorchBackend, "warp": WarpBackend}


def register_backend(name: str, make: Callable[[], TorchBackend]) -> None:
    """Register a backend, for ``Solver(backend=name)``.

    Args:
        name: Its name. One that is known already is replaced.
        make: Called with no arguments for each layer that is made.
    """
    BACKENDS[name] = make


def names() -> tuple[str, ...]:
    """What :func:`choose` takes."""
    return ("auto", *BACKENDS)


def choose(name: str) -> TorchBackend:
    """The backend of a name; ``"auto"`` is the kernels where they work, otherwise torch.

    Raises:
        MissingPackageError: ``"warp"`` is requested and not installed.
    """
    if name == "auto":
        name = "warp" if WarpBackend.works() else "torch"
    return BACKENDS[name]()
