"""torchdeform: registration of images by maps that do not fold, built from divergence and curl.

The public names stand in ``__init__.pyi`` and are loaded when they are first used, so ``import torchdeform`` costs
little more than ``import torch``.
"""

import os
import sys

import lazy_loader

# OpenMP's threads spin while they wait for each other. Where another program has one of the cores that made a
# registration 25 times slower; after a short spin they sleep instead. Read once, when torch is loaded.
if "torch" not in sys.modules:
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
