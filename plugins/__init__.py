"""The Mitsuba plugins, one file each. Importing this package registers them for every variant that is set now or later.

A plugin derives from classes of the current variant (`mi.Mesh`, `mi.BSDF`, ...), so its module is executed again
whenever a variant is set, as Mitsuba does with its own Python integrators.
"""

import importlib
import sys

import mitsuba as mi

PLUGINS = ("neural_albedo", "neural_sdf", "sira_bsdf", "sg_envmap", "sira_radiance", "sira_sg")


def register_plugins(old: str | None = None, new: str | None = None) -> None:
    """Registers every plugin for the current variant; scalar variants have no automatic differentiation and are
    left out. The arguments are those of Mitsuba's variant callback."""
    variant = mi.variant()
    if variant is None or variant.startswith("scalar"):
        return
    for name in PLUGINS:
        module = f"{__name__}.{name}"
        if module in sys.modules:
            importlib.reload(sys.modules[module])
        else:
            importlib.import_module(module)


mi.detail.add_variant_callback(register_plugins)
register_plugins()
