"""The structure of the project: which module may import which, and what the wheel holds."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import mitsuba as mi
import pytest

import sira_mi
from sira_mi.errors import InputError

ROOT = Path(__file__).resolve().parent.parent


def _copy(folder: Path, *names: str) -> None:
    for name in names:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", ".*"))
        else:
            shutil.copy(ROOT / name, folder / name)


def test_imports_follow_the_floors(tmp_path):
    """The contracts of `pyproject.toml` hold with `plugins/` where it installs to, and see imports inside functions."""
    _copy(tmp_path, "sira_mi", "studies", "pyproject.toml")
    _copy(tmp_path / "sira_mi", "plugins")
    command = [str(Path(sys.executable).parent / "lint-imports"), "--no-cache"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    with (tmp_path / "sira_mi" / "plugins" / "sira_sg.py").open("a") as plugin:
        plugin.write("\n\ndef upwards():\n    from sira_mi.fit import settings\n")
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 1 and "sira_mi.plugins is not allowed to import sira_mi.fit" in result.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """A wheel built from a copy of the sources, so that none of an earlier build gets into it."""
    source, built = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    _copy(source, "sira_mi", "plugins", "scenes", "pyproject.toml", "setup.py", "README.md", "LICENSE")
    command = [sys.executable, "-m", "pip", "wheel", str(source), "--no-deps", "--no-build-isolation", "-w", str(built)]
    result = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"PYTHONWARNINGS": "error"})
    assert result.returncode == 0, result.stdout + result.stderr
    return next(built.glob("*.whl"))


@pytest.mark.slow
def test_the_wheel_is_the_product(wheel):
    """Plugins, scenes and models are in the wheel; studies, tests and training data are not."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        lines = {n: archive.read(n).count(b"\n") for n in names if n.endswith(".py")}
    for name in ("plugins/sira_sg.py", "scenes/fit.xml", "scenes/lights/studio.exr", "py.typed"):
        assert f"sira_mi/{name}" in names
    for file in [*ROOT.glob("sira_mi/portrait/models/*"), ROOT / "sira_mi" / "avatar" / "prior.safetensors"]:
        assert str(file.relative_to(ROOT)) in names
    assert {n.split("/")[0] for n in names} == {"sira_mi", f"sira_mi-{sira_mi.__version__}.dist-info"}
    assert not [n for n in names if n.startswith("sira_mi/training/collection/data/")]
    assert sum(lines.values()) < 17_400
    assert sum(count for n, count in lines.items() if not n.startswith("sira_mi/training/")) < 11_800


def test_shipped_scenes_are_found():
    """`scene_path` leads to a scene that loads; a wrong name is answered with those that exist."""
    mi.load_file(sira_mi.scene_path("fit.xml"), width=8, height=8, voxel=0.2, baked=False)
    with pytest.raises(InputError, match=r"fit\.xml, relight\.xml"):
        sira_mi.scene_path("none.xml")
