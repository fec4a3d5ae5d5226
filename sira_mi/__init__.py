"""SIRA for Mitsuba 3: one portrait photo in, a relightable 3D head out.

Importing this package finds an LLVM for Dr.Jit and has the plugins `neural_sdf`, `neural_albedo`, `sira_bsdf`,
`sg_envmap`, `sira_radiance` and `sira_sg` registered for every Mitsuba variant that is set now or later.
"""

from sira_mi._llvm import configure_llvm
from sira_mi._registration import register_plugins_with_mitsuba

configure_llvm()
register_plugins_with_mitsuba()

__version__ = "0.1.0"
