"""Files in and out: images, labels, points, displacement fields and transforms, in ITK's conventions.

The names stand in ``__init__.pyi`` and are loaded when they are first used: a process that only calls a C library
needs no torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
