"""SIRA for Mitsuba 3: one portrait photo in, a relightable 3D head out.

Importing this package finds an LLVM for Dr.Jit and registers the plugins `neural_sdf`, `neural_albedo`, `sira_bsdf`,
`sg_envmap`, `sira_radiance` and `sira_sg` for every Mitsuba variant that is set now or later.
"""

from pathlib import Path

from sira_mi._llvm import configure_llvm
from sira_mi._registration import register_plugins_with_mitsuba
from sira_mi.errors import InputError

__version__ = "0.1.0"
__all__ = ["scene_path"]

configure_llvm()
register_plugins_with_mitsuba()


def scene_path(name: str) -> str:
    """The path of a shipped scene or light, for `mi.load_file`: `fit.xml`, `relight.xml`, `lights/studio.exr`, …

    Raises InputError when there is no such file."""
    package = Path(__file__).resolve().parent
    folder = next(f for f in (package / "scenes", package.parent / "scenes") if f.is_dir())  # installed, checkout
    if not (folder / name).is_file():
        raise InputError(f"no scene file {name}; there are {', '.join(sorted(p.name for p in folder.glob('*.xml')))}")
    return str(folder / name)
