"""The emitter `sg_envmap`: an environment of spherical Gaussians."""

from pathlib import Path
from typing import Any, NamedTuple, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.decoders import light_refinement
from sira_mi.avatar.file import load_avatar
from sira_mi.errors import InputError
from sira_mi.fields.mlp import layers
from sira_mi.plugins._parameters import can_evaluate, check_numbers, read_integer, read_number, read_similarity
from sira_mi.plugins.neural_albedo import find_avatar
from sira_mi.sg.fit_environment import EnvironmentFit, fit_environment
from sira_mi.sg.lights_io import MAXIMUM_LOBES, check_lobes, read_environment, read_lights
from sira_mi.sg.sampling import LobeMixture

# Distance of the environment in scene units; a Python emitter is not told the size of its scene.
FAR_DISTANCE = 1e5
# Dim and near-constant: the light when no lobes are given.
DEFAULT_LOBES = np.array([[0.0, 1.0, 0.0, 1e-3, 0.2, 0.2, 0.2]])


class LightRefinement(NamedTuple):
    """The network of an avatar that refines its light."""

    network: list[tuple]
    octaves: int

    def factor(self, x_ref, gamma):
        """Factor of the radiance [3, N] at points of the reference space."""
        return dr.exp(light_refinement(self.network, self.octaves, x_ref, gamma))


def read_refinement(path: str) -> LightRefinement | None:
    """The light refinement of an avatar file; None without a path and where the avatar has none."""
    avatar = load_avatar(path) if path else None
    if avatar is None or "light_refinement" not in avatar.tensors:
        return None
    network = avatar.architecture.networks["light_refinement"]
    parameters = mi.Float(avatar.tensors["light_refinement"])
    return LightRefinement(layers(network, parameters), avatar.architecture.refinement_octaves)


class SGEnvmap(mi.Emitter):
    r"""Environment of spherical Gaussians (:monosp:`sg_envmap`)
    -----------------------------------------------------------

    .. pluginparameters::

     * - lobes
       - |tensor|
       - N_l × 7: axis (3, any non-zero length), sharpness λ > 0, linear RGB amplitude (3, not negative); 1 to 4096
         lobes. (Default: one near-constant lobe of radiance 0.2)
       - |exposed|, |differentiable|

     * - filename
       - |string|
       - A `.json` file `{"lobes": [{"axis": [x, y, z], "sharpness": λ, "amplitude": [r, g, b]}, ...]}`, or a
         latitude-longitude `.exr`, to which `lobe_count` lobes are fitted. Excludes `lobes`.

     * - lobe_count
       - |int|
       - Number of lobes fitted to an `.exr`. (Default: 64)

     * - light_refinement
       - |string|
       - An `avatar.safetensors` whose fitted light this is. `sira_sg` multiplies the radiance of the head by the
         avatar's refinement of that light; other integrators ignore it. (Default: none)

     * - scale
       - |float|
       - Factor of the radiance, not negative. (Default: 1)
       - |exposed|, |differentiable|

     * - to_world
       - |transform|
       - Rotation of the environment; translation and uniform scale have no effect. (Default: none)

    The radiance from direction d is l(d) = Σ μ exp(λ(d·ξ − 1)), oriented like Mitsuba's `envmap`. To sample it, a lobe
    is chosen in proportion to the luminance of its energy, then a direction from the lobe's von Mises-Fisher density.
    The sampling density is that of the whole mixture.

    It does not emit rays (`sample_ray`), so particle tracers such as `ptracer` cannot use it. It needs an RGB or
    monochrome variant and a scene much smaller than 1e5 units, the distance at which the light is placed. Axes are
    scaled to unit length when the plugin is loaded; derivatives by `lobes` are those at the scaled axes. They flow
    through the radiance, not through the sampling, and have no bias; where few samples meet a sharp lobe, those of one
    rendering may be off by a third. Inside Mitsuba's symbolic loops, gradients of `lobes` are summed by atomics, and
    their last bits vary between runs. An update refuses the values that loading refuses.

    Source: the light model of eq. 8 of SIRA (Caselles et al. 2022), after PhySG (Zhang et al. 2021).

    .. code-block:: python

        "light": {
            "type": "sg_envmap",
            "lobes": mi.TensorXf([[0, 1, 0, 2.0, 0.5, 0.6, 0.8], [0.6, 0.5, 0.6, 80.0, 9.0, 8.0, 7.0]]),
        }
    """

    def __init__(self, props):
        super().__init__(props)
        if mi.is_spectral or mi.is_polarized:
            raise InputError("sg_envmap works in RGB and monochrome variants, such as llvm_ad_rgb")
        self.m_flags = mi.EmitterFlags.Infinite | mi.EmitterFlags.SpatiallyVarying
        self.scale = mi.Float(read_number(props, "sg_envmap", "scale", 1.0, 0.0))
        count = read_integer(props, "sg_envmap", "lobe_count", 64, 1, MAXIMUM_LOBES)
        matrix, size = read_similarity(props, "sg_envmap")
        rotation = np.eye(4)
        rotation[:3, :3] = matrix[:3, :3] / size
        self.rotation = mi.Transform4f(cast(Any, rotation))  # the stubs leave out float64
        if "lobes" in props and "filename" in props:
            raise InputError("sg_envmap: give either lobes or filename, not both")
        if "filename" in props:
            lobes = self._read(props["filename"], count)
        else:
            lobes = check_lobes(np.array(props["lobes"]) if "lobes" in props else DEFAULT_LOBES, "sg_envmap")
        self.lobes = mi.TensorXf(lobes)
        self.refinement = read_refinement(find_avatar(props, "light_refinement"))
        self._check()
        self._prepare()

    @staticmethod
    def _read(filename, count):
        resolver: Any = mi.file_resolver  # a function, which the stubs call an object
        path = str(resolver().resolve(filename))
        suffix = Path(path).suffix.lower()
        if suffix == ".json":
            return read_lights(path)
        if suffix == ".exr":
            return fit_environment(read_environment(path), EnvironmentFit(lobes=count))
        raise InputError(f"{path}: sg_envmap reads .json and .exr files")

    def _check(self):
        """Raises InputError for values that are no light."""
        if not can_evaluate(self.lobes, self.scale):
            return
        lobes, scale = dr.detach(self.lobes).numpy(), dr.detach(self.scale).numpy()
        check_lobes(lobes, "sg_envmap")
        check_numbers("sg_envmap", "scale", scale, 0.0)
        if not 4 * np.pi * lobes[:, 4:].sum(axis=0, dtype=np.float64).max() * scale.max() < np.finfo(np.float32).max:
            raise InputError("sg_envmap: lobes times scale are brighter than single precision holds")

    def _prepare(self):
        self.mixture = LobeMixture(self.lobes)

    def traverse(self, callback):
        callback.put("lobes", self.lobes, mi.ParamFlags.Differentiable)
        callback.put("scale", self.scale, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys=()):
        self._check()
        if not keys or "lobes" in keys:
            self._prepare()

    def _evaluate(self, direction):
        """Radiance and sampling density of a world direction."""
        radiance, pdf = self.mixture.evaluate(self.rotation.inverse() @ direction)
        radiance = radiance * self.scale
        return mi.Spectrum(mi.luminance(radiance)) if mi.is_monochromatic else radiance, pdf

    def eval(self, si, active=True):
        return self._evaluate(-si.wi)[0] & active

    def sample_direction(self, it, sample, active=True):
        direction = dr.normalize(self.rotation @ self.mixture.sample(sample, active))
        ds: Any = dr.zeros(mi.DirectionSample3f)  # the stubs give its fields other types
        ds.p = dr.fma(direction, FAR_DISTANCE, it.p)
        ds.n, ds.d, ds.dist = -direction, direction, mi.Float(FAR_DISTANCE)
        ds.uv, ds.time, ds.delta = mi.Point2f(0.0), it.time, mi.Bool(False)
        ds.emitter = mi.EmitterPtr(self)
        radiance, pdf = self._evaluate(direction)
        ds.pdf = dr.select(active, pdf, 0.0)
        active = active & (pdf > 0.0)
        return ds, dr.select(active, radiance / dr.select(pdf > 0.0, pdf, 1.0), 0.0)

    def pdf_direction(self, it, ds, active=True):
        return dr.select(active, self._evaluate(ds.d)[1], 0.0)

    def eval_direction(self, it, ds, active=True):
        return self._evaluate(ds.d)[0] & active

    def bbox(self):
        return mi.ScalarBoundingBox3f()

    def to_string(self):
        return f"SGEnvmap[lobes = {self.mixture.count}, scale = {self.scale}]"


mi.register_emitter("sg_envmap", lambda props: SGEnvmap(props))
