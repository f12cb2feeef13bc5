"""The experiment simulated before anything moves: what to expect, and the largest safe amplitude.

`hil.dry_run("arm.toml")` simulates one: see hil.api.dry_run.
"""

import sys
from types import ModuleType
from typing import Any


class _CallableModule(ModuleType):
    """`hil.dry_run` is the front door's function, or this package once a module of it was imported: call either."""

    def __call__(self, *args: Any, **options: Any) -> Any:
        import hil

        return hil.__getattr__("dry_run")(*args, **options)


sys.modules[__name__].__class__ = _CallableModule
