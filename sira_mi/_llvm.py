"""Finds an LLVM for Dr.Jit, so that `pip install` is the whole set-up."""

import os
import sys
import sysconfig
import warnings
from pathlib import Path


def locate_llvm() -> Path | None:
    """The newest libLLVM that a PyPI package put beside this interpreter, or None.

    Looks in the environment's `lib` folder (`karellen-llvm-core` installs `libLLVM.so.23.1` there)."""
    patterns = {"darwin": "libLLVM*.dylib", "win32": "LLVM-C.dll"}.get(sys.platform, "libLLVM*.so*")
    folders = [Path(sysconfig.get_path("data")) / "lib", Path(sys.prefix) / "lib", Path(sys.prefix) / "bin"]
    found = [file for folder in folders if folder.is_dir() for file in folder.glob(patterns) if file.is_file()]
    return max(found, key=lambda file: (file.name.count("."), file.name), default=None)


def configure_llvm() -> None:
    """Sets `DRJIT_LIBLLVM_PATH`, which Dr.Jit reads when it is imported, unless the user has set it to a path.

    Warns when Dr.Jit is already imported: it may not have found this LLVM."""
    if os.environ.get("DRJIT_LIBLLVM_PATH") or (library := locate_llvm()) is None:
        return
    if "drjit" in sys.modules:
        warnings.warn(
            "import sira_mi before mitsuba and drjit: they look for LLVM when imported, and may not have found "
            "the one installed with sira_mi",
            stacklevel=3,
        )
    os.environ["DRJIT_LIBLLVM_PATH"] = str(library)
