"""Starting up: `--help` is quick, plugins load only what they use, and are registered in any order of imports."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import sira_mi

HEAVY = ("mitsuba", "drjit", "numpy", "scipy", "cv2", "skimage", "trimesh", "OpenEXR", "PIL")


def run(code: str) -> str:
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_help_loads_nothing_heavy():
    """`--help` of every command, and `import sira_mi`, load neither Mitsuba nor NumPy nor other slow packages."""
    folder = Path(sira_mi.__file__).parent
    files = sorted(folder.rglob("__main__.py"))
    commands = [".".join(file.parent.relative_to(folder.parent).parts) for file in files]
    code = f"""
import contextlib, io, runpy, sys
import sira_mi
for name in {commands}:
    sys.argv = [name, "--help"]
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()) as text:
        runpy.run_module(name, run_name="__main__")
    assert "usage" in text.getvalue(), name
    loaded = [m for m in {HEAVY} if m in sys.modules]
    assert not loaded, (name, loaded)
print("fine")
"""
    expected = {f"sira_mi.{name}" for name in ("crosscheck", "fit", "relight", "training")}
    assert expected <= set(commands) and run(code).strip() == "fine"


def test_plugins_load_no_more_than_they_use():
    """A variant with all plugins needs no optimiser, no image library and no mesh library."""
    code = """
import sys, sira_mi, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
mi.load_dict({"type": "sg_envmap"}), mi.load_dict({"type": "sira_bsdf"}), mi.load_dict({"type": "sira_sg"})
print(*(m for m in ("scipy", "cv2", "skimage", "trimesh", "tqdm") if m in sys.modules))
"""
    assert run(code).split() == []


@pytest.mark.parametrize("first", ["sira_mi", "mitsuba", "sira_mi.plugins"])
def test_plugins_are_there_whichever_is_imported_first(first):
    code = f"""
import {first}
import mitsuba as mi
import sira_mi
for variant in ("scalar_rgb", "llvm_ad_rgb"):
    mi.set_variant(variant)
print(mi.load_dict({{"type": "sg_envmap"}}))
"""
    assert "SGEnvmap" in run(code)


@pytest.mark.slow
def test_plugins_are_there_for_variants_that_are_set_later(avatar_path):
    """Import first, then two variants in turn."""
    code = f"""
import sira_mi, mitsuba as mi, numpy as np
for variant in ("llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_rgb"):
    mi.set_variant(variant)
    scene = mi.load_dict({{
        "type": "scene",
        "head": {{"type": "neural_sdf", "avatar": {avatar_path!r}, "voxel": 0.4, "bsdf": {{
            "type": "sira_bsdf", "diffuse_albedo": {{"type": "neural_albedo", "avatar": {avatar_path!r}}}}}}},
        "light": {{"type": "sg_envmap"}},
        "sensor": {{"type": "perspective", "fov": 40, "film": {{"type": "hdrfilm", "width": 8, "height": 8}},
                   "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])}},
    }})
    names = ("direct", "sira_radiance", "sira_sg")
    options = {{"sira_radiance": {{"avatar": {avatar_path!r}}}}}
    for integrator in ({{"type": name, **options.get(name, {{}})}} for name in names):
        if variant == "llvm_ad_mono" and integrator["type"] != "direct":
            mi.load_dict(integrator)
            continue
        image = mi.render(scene, integrator=mi.load_dict(integrator), spp=1).numpy()
        assert np.isfinite(image).all() and image[3:5, 3:5, :3].min() > 0, (variant, integrator)
    print(flush=True)
    print(variant, flush=True)
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=200)
    assert result.returncode == 0, result.stderr[-2000:]
    lines = [line for line in result.stdout.splitlines() if line.startswith("llvm")]
    assert lines == ["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_rgb"]


@pytest.mark.slow
@pytest.mark.parametrize("path, code", [("", 0), ("/missing/libLLVM.so", 2), (__file__, 2)])
def test_an_llvm_that_cannot_be_used_is_one_line(path, code):
    """An empty DRJIT_LIBLLVM_PATH is as none; one that names no library is said."""
    command = """
from sira_mi.errors import run_command
def main():
    from sira_mi.variants import set_variant
    set_variant("llvm_ad_rgb")
run_command(main)
"""
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": path}
    result = subprocess.run(
        [sys.executable, "-c", command], env=environment, capture_output=True, text=True, timeout=120
    )
    assert result.returncode == code, result.stderr
    if code:
        assert result.stderr.splitlines()[-1].startswith("error: Dr.Jit cannot use the LLVM")
        assert path in result.stderr and "Traceback" not in result.stderr
