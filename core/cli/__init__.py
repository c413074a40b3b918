"""The command ``zonda``. Each command imports what it needs: ``zonda --help`` must stay quick."""

from .entry import main as main
from .entry import zonda as zonda
