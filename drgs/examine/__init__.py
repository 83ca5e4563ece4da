"""Find out which effects photographs need.

Python gives ``drgs.examine`` to this package as soon as one of its modules is imported: so the
package can be called, and stands for :func:`drgs.examine.examination.examine`.
"""

from __future__ import annotations

import sys
from types import ModuleType


class _CallablePackage(ModuleType):
    def __call__(self, *args: object, **kwargs: object) -> object:
        """Call :func:`drgs.examine.examination.examine`."""
        from drgs.examine.examination import examine

        return examine(*args, **kwargs)  # pyright: ignore[reportArgumentType]  # as they are given


sys.modules[__name__].__class__ = _CallablePackage
