"""For tests of plugins: `check_operator`."""

from zonda.core.testing import check_operator as check_operator

__all__ = ["check_operator"]
