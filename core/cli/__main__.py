"""``python -m zonda.core.cli``."""

import sys

from . import main

sys.exit(main())
