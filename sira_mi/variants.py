"""The variants of Mitsuba that the project can run on."""

import os

import mitsuba as mi

from sira_mi.errors import InputError


def set_variant(variant: str) -> None:
    """Sets a Mitsuba variant with automatic differentiation. Raises InputError for any other, and when Dr.Jit has no
    LLVM or no GPU for it."""
    usable = [v for v in mi.variants() if "_ad_" in v and v.endswith("rgb")]
    if variant not in usable:
        raise InputError(f"no variant {variant}; this Mitsuba has {', '.join(usable)}")
    try:
        mi.set_variant(variant)
    except ImportError as error:
        if "backend" not in str(error):
            raise
        raise InputError(_describe_missing(variant)) from error


def _describe_missing(variant: str) -> str:
    if variant.startswith("cuda"):
        return f"Dr.Jit cannot use an NVIDIA GPU for {variant}; install its driver, or use --variant llvm_ad_rgb"
    if path := os.environ.get("DRJIT_LIBLLVM_PATH"):
        return (
            f"Dr.Jit cannot use the LLVM that DRJIT_LIBLLVM_PATH names, {path}; unset the variable, or set it to the "
            "path of an LLVM library that is newer or is there"
        )
    return (
        "Dr.Jit finds no LLVM; install it (Linux: pip install karellen-llvm-core, on ARM apt install llvm; macOS: "
        "brew install llvm; Windows: the installer of llvm.org), and if that is not enough set "
        "DRJIT_LIBLLVM_PATH to the path of its library"
    )
