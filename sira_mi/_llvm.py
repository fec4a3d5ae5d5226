"""Finds an LLVM for Dr.Jit, so that `pip install` is the whole set-up."""

import os
import sys
import sysconfig
from pathlib import Path


def locate_llvm() -> Path | None:
    """The libLLVM that a PyPI package put beside this interpreter, newest first, or None.

    Looks in the environment's `lib` folder (`karellen-llvm-core` installs `libLLVM.so.23.1` there)."""
    patterns = {"darwin": "libLLVM*.dylib", "win32": "LLVM-C.dll"}.get(sys.platform, "libLLVM*.so*")
    folders = [Path(sysconfig.get_path("data")) / "lib", Path(sys.prefix) / "lib", Path(sys.prefix) / "bin"]
    found = [file for folder in folders if folder.is_dir() for file in folder.glob(patterns) if file.is_file()]
    return max(found, key=lambda file: (file.name.count("."), file.name), default=None)


def configure_llvm() -> None:
    """Sets `DRJIT_LIBLLVM_PATH` before Dr.Jit is first imported; a value that the user set is left alone."""
    if "DRJIT_LIBLLVM_PATH" not in os.environ and (library := locate_llvm()) is not None:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(library)
