"""The sizes of an avatar's networks and latents."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from sira_mi.errors import InputError
from sira_mi.fields.encoding import encoded_size
from sira_mi.fields.mlp import Architecture


@dataclass(frozen=True)
class AvatarArchitecture:
    """Sizes of all decoders; octaves belong to the positional encoding of each network's point."""

    features: int = 16  # N_γ, length of the auxiliary feature vector γ
    sdf_octaves: int = 4
    sdf_width: int = 96
    sdf_depth: int = 4
    sdf_latent: int = 128  # dimension of z_sdf
    rendering_octaves: int = 5
    rendering_width: int = 96
    rendering_depth: int = 3
    rendering_latent: int = 64  # dimension of z_r
    albedo_octaves: int = 6
    albedo_width: int = 64
    albedo_depth: int = 3
    albedo_latent: int = 32  # dimension of z_a
    specular_octaves: int = 4
    specular_width: int = 32
    specular_depth: int = 2
    specular_latent: int = 8  # dimension of z_s
    refinement_octaves: int = 5
    refinement_width: int = 96
    refinement_depth: int = 3
    lobes: int = 48  # N_l, number of spherical Gaussians of the illumination decoder
    illumination_width: int = 64
    illumination_depth: int = 2
    illumination_latent: int = 24  # dimension of z_l

    def __post_init__(self):
        if any(not isinstance(v, int) or not 0 < v <= 4096 for v in dataclasses.asdict(self).values()):
            raise ValueError("every size of an avatar is a whole number from 1 to 4096")

    def to_dict(self) -> dict[str, int | bool]:
        """For files: every size, and `deforms`, which is always true. Earlier versions also had heads without a
        deformation."""
        return {**dataclasses.asdict(self), "deforms": True}

    @classmethod
    def from_dict(cls, sizes: dict, path: Path) -> AvatarArchitecture:
        """What `to_dict` wrote to the file `path`. Raises InputError for a head without a deformation, TypeError or
        ValueError for anything that is no architecture."""
        sizes = {**sizes}
        if sizes.pop("deforms", True) is not True:
            raise InputError(f"{path} is of heads without a deformation, which this version lacks; train it again")
        return cls(**sizes)

    @cached_property
    def networks(self) -> dict[str, Architecture]:
        """The architecture of every network, by the name of its tensor."""
        gamma = self.features
        sdf = encoded_size(self.sdf_octaves)
        albedo = encoded_size(self.albedo_octaves) + gamma
        width, depth = self.sdf_width, self.sdf_depth
        return {
            "deformation": Architecture(sdf, 3 + gamma, width, depth, self.sdf_latent),
            "reference": Architecture(sdf, 1, width, depth),
            "rendering": Architecture(
                encoded_size(self.rendering_octaves) + 6 + gamma,
                3,
                self.rendering_width,
                self.rendering_depth,
                self.rendering_latent,
            ),
            "diffuse_albedo": Architecture(albedo, 3, self.albedo_width, self.albedo_depth, self.albedo_latent),
            "specular_albedo": Architecture(
                encoded_size(self.specular_octaves),
                1,
                self.specular_width,
                self.specular_depth,
                self.specular_latent,
            ),
            "albedo_refinement": Architecture(
                encoded_size(self.refinement_octaves) + gamma, 3, self.refinement_width, self.refinement_depth
            ),
            "light_refinement": Architecture(
                encoded_size(self.refinement_octaves) + gamma, 3, self.refinement_width, self.refinement_depth
            ),
            "illumination": Architecture(
                self.illumination_latent, 7 * self.lobes, self.illumination_width, self.illumination_depth
            ),
        }

    @cached_property
    def latents(self) -> dict[str, int]:
        """Dimension of every latent, by the name of its tensor."""
        return {
            "z_sdf": self.sdf_latent,
            "z_r": self.rendering_latent,
            "z_a": self.albedo_latent,
            "z_s": self.specular_latent,
            "z_l": self.illumination_latent,
        }
