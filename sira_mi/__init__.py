"""SIRA for Mitsuba 3: one portrait photo in, a relightable 3D head out.

Importing this package finds an LLVM for Dr.Jit and registers the plugins `neural_sdf`, `neural_albedo`, `sira_bsdf`,
`sg_envmap`, `sira_radiance` and `sira_sg` for every Mitsuba variant that is set now or later.
"""

from sira_mi._llvm import configure_llvm

configure_llvm()

import sira_mi.plugins  # noqa: E402, F401  (registers the plugins; Dr.Jit must find LLVM first)

__version__ = "0.1.0"
