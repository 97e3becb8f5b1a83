"""Physically plausible in-between shapes from key-frame meshes, in a space of vibration modes.

The public names stand in ``__init__.pyi``; each is loaded when it is first used (PEP 562).
"""

import lazy_loader

from torch_modal.version import __version__ as __version__

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
