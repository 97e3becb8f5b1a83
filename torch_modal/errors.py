"""What the border raises and warns with."""


class MeshWarning(UserWarning):
    """Input that works, but not in every respect as its owner may expect."""


class MissingPackageError(ImportError):
    """An optional package is not installed; the message says which, and how to get it."""


class MeshError(ValueError):
    """Input that cannot work: a file, an array or a mesh."""
