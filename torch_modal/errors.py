"""Exceptions and warnings."""


class MeshWarning(UserWarning):
    """Usable input with possibly unexpected effects."""


class MissingPackageError(ImportError):
    """An optional package is not installed; the message says how to install it."""


class MeshError(ValueError):
    """Input that cannot work: a file, an array or a mesh."""


class ModalAnalysisError(RuntimeError):
    """The mesher failed, or the eigenproblem has no trustworthy solution; the message says why, and gives a remedy."""


class ConvergenceError(RuntimeError):
    """A gradient was requested through a minimisation that did not converge."""
