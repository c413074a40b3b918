"""``python -m zonda`` is the command ``zonda``."""

import sys

from zonda.core.cli import main

if __name__ == "__main__":
    sys.exit(main())
