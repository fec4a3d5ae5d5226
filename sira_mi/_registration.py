"""Registers the plugins with Mitsuba, whichever of the two packages is imported first.

Importing `sira_mi` does not import Mitsuba: a command that only checks its options starts without it."""

import importlib
import importlib.util
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

_PLUGINS = "sira_mi.plugins"


class _MitsubaFinder:
    """Finds Mitsuba as usual, and imports the plugins right after it."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        if name != "mitsuba":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        if spec is None or spec.loader is None:
            sys.meta_path.insert(0, self)
            return spec
        loader: Any = spec.loader  # a method of this one loader is replaced
        execute = loader.exec_module

        def execute_and_register(module: ModuleType) -> None:
            execute(module)
            importlib.import_module(_PLUGINS)

        loader.exec_module = execute_and_register
        return spec


def register_plugins_with_mitsuba() -> None:
    """Imports the plugins, which register themselves for every variant: now if Mitsuba is loaded, else once it is."""
    if "mitsuba" in sys.modules:
        importlib.import_module(_PLUGINS)
    else:
        sys.meta_path.insert(0, _MitsubaFinder())
