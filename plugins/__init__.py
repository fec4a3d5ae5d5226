"""The Mitsuba plugins, one file each. Importing this package registers them for every variant that is set now or later.

A plugin derives from classes of the current variant (`mi.Mesh`, `mi.BSDF`, ...), so its module is executed once for
each variant, as Mitsuba does with its own Python integrators.
"""

import importlib
import sys
from typing import Any, NoReturn

import mitsuba as mi

from sira_mi.errors import InputError

PLUGINS = {
    "neural_albedo": "texture",
    "neural_sdf": "shape",
    "sira_bsdf": "bsdf",
    "sg_envmap": "emitter",
    "sira_radiance": "integrator",
    "sira_sg": "integrator",
}
# What each module held when it had been executed for a variant. Scenes keep their classes when the variant comes back.
_namespaces: dict[str, dict[str, dict[str, Any]]] = {}


def register_plugins(old: str | None = None, new: str | None = None) -> None:
    """Registers every plugin for the current variant; scalar variants have no automatic differentiation, and plugins
    that say so. The arguments are those of Mitsuba's variant callback."""
    variant = mi.variant()
    if variant is None:
        return
    if variant in _namespaces:
        for module, namespace in _namespaces[variant].items():
            vars(sys.modules[module]).update(namespace)
        return
    _namespaces[variant] = {}
    if variant.startswith("scalar"):
        for name, kind in PLUGINS.items():
            getattr(mi, f"register_{kind}")(name, lambda props, name=name: _refuse(name, variant))
        return
    for name in PLUGINS:
        module = f"{__name__}.{name}"
        if module in sys.modules:
            importlib.reload(sys.modules[module])
        else:
            importlib.import_module(module)
        _namespaces[variant][module] = dict(vars(sys.modules[module]))


def _refuse(name: str, variant: str) -> NoReturn:
    raise InputError(f"{name}: it does not work in the variant {variant}; set llvm_ad_rgb or cuda_ad_rgb")


mi.detail.add_variant_callback(register_plugins)
register_plugins()
