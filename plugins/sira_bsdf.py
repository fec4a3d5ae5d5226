"""The BSDF `sira_bsdf`: diffuse albedo and the simplified Disney specular term of eq. 8."""

from typing import Any

import drjit as dr
import mitsuba as mi

from sira_mi.plugins._parameters import can_evaluate, check_numbers, read_number
from sira_mi.plugins.neural_albedo import NeuralAlbedo
from sira_mi.sg import brdf

# Smallest and largest values of the numbers that an update may change.
BOUNDS = {"roughness": (brdf.MINIMUM_ROUGHNESS, brdf.MAXIMUM_ROUGHNESS), "k_s": (0.0, float("inf"))}


class SiraBSDF(mi.BSDF):
    r"""Reflectance of eq. 8 (:monosp:`sira_bsdf`)
    ---------------------------------------------

    .. pluginparameters::

     * - diffuse_albedo
       - |spectrum| or |texture|
       - Diffuse albedo a. (Default: 0.5)
       - |exposed|, |differentiable|

     * - specular_albedo
       - |float| or |texture|
       - Specular albedo s, one channel: the reflectance at normal incidence. (Default: 0.5)
       - |exposed|, |differentiable|

     * - roughness
       - |float|
       - Roughness r, from 0.02 to 1. (Default: 0.5)
       - |exposed|, |differentiable|

     * - k_s
       - |float|
       - Weight of the specular term, not negative. (Default: 1)
       - |exposed|, |differentiable|

    f = a/π + k_s D F G / (4 (n·l)(n·v)) with D = exp(2/r⁴ (h·n − 1)) / (πr⁴),
    F = s + (1 − s) 2^{−(5.55473 v·h + 6.8316) v·h} and Schlick-Smith's G with k = (r + 1)²/8: the reflectance that
    closed-form shading integrates (`sira_mi.sg.brdf`).

    One-sided; nest it in `twosided` for both sides. Reciprocal, but not energy-conserving: the diffuse term is not
    reduced by what the specular term reflects, and the specular term is not normalised at grazing angles. Directions
    are sampled from a mixture of the cosine lobe and the reflected normal distribution.

    Source: SIRA (Caselles et al. 2022), eq. 8, after PhySG (Zhang et al. 2021) and Karis, "Real Shading in Unreal
    Engine 4" (2013).

    .. code-block:: python

        "bsdf": {
            "type": "sira_bsdf",
            "diffuse_albedo": {"type": "rgb", "value": [0.6, 0.4, 0.3]},
            "specular_albedo": 0.03,
            "roughness": 0.5,
        }
    """

    def __init__(self, props):
        super().__init__(props)
        self.diffuse_albedo = self._texture(props, "diffuse_albedo")
        self.specular_albedo = self._texture(props, "specular_albedo")
        self.roughness = mi.Float(read_number(props, "sira_bsdf", "roughness", 0.5, *BOUNDS["roughness"]))
        self.k_s = mi.Float(read_number(props, "sira_bsdf", "k_s", 1.0, *BOUNDS["k_s"]))
        side: Any = mi.BSDFFlags.FrontSide  # flags combine to integers
        if any(texture.is_spatially_varying() for texture in (self.diffuse_albedo, self.specular_albedo)):
            side = side | mi.BSDFFlags.SpatiallyVarying
        self.m_components = [mi.BSDFFlags.GlossyReflection | side, mi.BSDFFlags.DiffuseReflection | side]
        self.m_flags = self.m_components[0] | self.m_components[1]

    @staticmethod
    def _texture(props, name):
        if hasattr(props, "get_texture"):
            return props.get_texture(name, 0.5)
        value = props.get(name, 0.5)
        return value if isinstance(value, mi.Texture) else mi.load_dict({"type": "uniform", "value": float(value)})

    def traverse(self, callback):
        callback.put("diffuse_albedo", self.diffuse_albedo, mi.ParamFlags.Differentiable)
        callback.put("specular_albedo", self.specular_albedo, mi.ParamFlags.Differentiable)
        callback.put("roughness", self.roughness, mi.ParamFlags.Differentiable)
        callback.put("k_s", self.k_s, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys=()):
        for name, bounds in BOUNDS.items():
            value = getattr(self, name)
            if (not keys or name in keys) and can_evaluate(value):
                check_numbers("sira_bsdf", name, dr.detach(value).numpy(), *bounds)

    def _components(self, ctx, active):
        glossy = mi.Bool(ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0))
        return glossy & active, mi.Bool(ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 1)) & active

    def _albedos(self, si, active):
        """Diffuse and specular albedo; networks may stand behind them, so each is asked once a call, and both at once
        where they belong to one head."""
        if isinstance(self.diffuse_albedo, NeuralAlbedo) and self.diffuse_albedo.shares_space(self.specular_albedo):
            return self.diffuse_albedo.eval_with(self.specular_albedo, si, active)
        return self.diffuse_albedo.eval(si, active), self.specular_albedo.eval_1(si, active)

    def _glossy_share(self, ctx, si, albedos):
        """Probability of sampling the specular lobe, by a rough estimate of the two albedos; detached."""
        with dr.suspend_grad():
            weight = self.k_s * brdf.fresnel(albedos[1], mi.Frame3f.cos_theta(si.wi))
            share = dr.clip(weight / dr.maximum(weight + dr.mean(albedos[0]), 1e-6), 0.1, 0.9)
            if not ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 1):
                share = mi.Float(1.0)
            if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0):
                share = mi.Float(0.0)
            return share

    def _value(self, ctx, si, wo, albedos, active):
        """f · cos of the light direction."""
        cos_light = mi.Frame3f.cos_theta(wo)
        active = active & ((mi.Frame3f.cos_theta(si.wi) > 0.0) & (cos_light > 0.0))
        glossy, diffuse = self._components(ctx, active)
        specular = brdf.specular_brdf(mi.Vector3f(0, 0, 1), si.wi, wo, albedos[1], self.roughness)
        value = dr.select(diffuse, albedos[0] * dr.inv_pi, 0.0)
        return dr.select(active, (value + dr.select(glossy, self.k_s * specular, 0.0)) * cos_light, 0.0)

    def _density(self, si, wo, share, active):
        with dr.suspend_grad():
            active = active & ((mi.Frame3f.cos_theta(si.wi) > 0.0) & (mi.Frame3f.cos_theta(wo) > 0.0))
            glossy = brdf.reflection_density(mi.Vector3f(0, 0, 1), si.wi, wo, self.roughness)
            return dr.select(active, dr.lerp(mi.warp.square_to_cosine_hemisphere_pdf(wo), glossy, share), 0.0)

    def sample(self, ctx, si, sample1, sample2, active=True):
        active = active & (mi.Frame3f.cos_theta(si.wi) > 0.0)
        albedos = self._albedos(si, active)
        share = self._glossy_share(ctx, si, albedos)
        glossy = sample1 < share
        with dr.suspend_grad():
            half = brdf.sample_distribution(sample2, self.roughness)
            wo = dr.select(glossy, mi.reflect(si.wi, half), mi.warp.square_to_cosine_hemisphere(sample2))
        bs: Any = dr.zeros(mi.BSDFSample3f)  # the stubs give its fields other types
        bs.wo = wo
        bs.pdf = self._density(si, wo, share, active)
        bs.eta = 1.0
        bs.sampled_component = dr.select(glossy, mi.UInt32(0), mi.UInt32(1))
        bs.sampled_type = dr.select(
            glossy, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
        )
        active = active & (bs.pdf > 0.0)
        value = self._value(ctx, si, wo, albedos, active) / dr.select(active, bs.pdf, 1.0)
        return bs, dr.select(active, value, 0.0)

    def eval(self, ctx, si, wo, active=True):
        return self._value(ctx, si, wo, self._albedos(si, active), active)

    def pdf(self, ctx, si, wo, active=True):
        return self._density(si, wo, self._glossy_share(ctx, si, self._albedos(si, active)), active)

    def eval_pdf(self, ctx, si, wo, active=True):
        albedos = self._albedos(si, active)
        share = self._glossy_share(ctx, si, albedos)
        return self._value(ctx, si, wo, albedos, active), self._density(si, wo, share, active)

    def eval_diffuse_reflectance(self, si, active=True):
        return self.diffuse_albedo.eval(si, active) & active

    def to_string(self):
        return (
            f"SiraBSDF[\n  diffuse_albedo = {self.diffuse_albedo},\n  specular_albedo = {self.specular_albedo},\n"
            f"  roughness = {self.roughness},\n  k_s = {self.k_s}\n]"
        )


mi.register_bsdf("sira_bsdf", lambda props: SiraBSDF(props))
