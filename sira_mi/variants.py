"""The variants of Mitsuba that the project can run on."""

import mitsuba as mi

from sira_mi.errors import InputError


def set_variant(variant: str) -> None:
    """Sets a Mitsuba variant with automatic differentiation. Raises InputError for any other."""
    usable = [v for v in mi.variants() if "_ad_" in v and v.endswith("rgb")]
    if variant not in usable:
        raise InputError(f"no variant {variant}; this Mitsuba has {', '.join(usable)}")
    mi.set_variant(variant)
