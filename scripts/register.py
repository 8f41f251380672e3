"""Register two images: the same as the command ``register``, for a checkout that is not installed."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from torchdeform.cli.main import main

sys.exit(main())
