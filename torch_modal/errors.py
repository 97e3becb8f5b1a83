"""Exceptions and warnings about input."""


class MeshWarning(UserWarning):
    """Usable input with possibly unexpected effects."""


class MissingPackageError(ImportError):
    """An optional package is not installed; the message says how to install it."""


class MeshError(ValueError):
    """Input that cannot work: a file, an array or a mesh."""
