"""Simulation of the experiment before anything moves: expected peaks, and the largest safe amplitude.

Call `hil.dry_run("arm.toml")` to simulate an experiment: see hil.api.dry_run.
"""

import sys
from types import ModuleType
from typing import Any


class _CallableModule(ModuleType):
    """Makes this package callable: `hil.dry_run` names both the function and the package."""

    def __call__(self, *args: Any, **options: Any) -> Any:
        import hil

        return hil.__getattr__("dry_run")(*args, **options)


sys.modules[__name__].__class__ = _CallableModule
