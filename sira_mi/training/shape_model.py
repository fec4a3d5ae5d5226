"""A trained SA-SM as a statistical model: its networks and the Gaussian of its latents.

Every latent is z = mean + basis w with w ~ N(0, I). The same w therefore serves the networks of a training, whose
latents have any mean and spread, and those of a prior, whose latents are standard normal.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sira_mi.avatar.architecture import AvatarArchitecture
from sira_mi.avatar.file import Avatar
from sira_mi.avatar.shape import HeadShape
from sira_mi.fields.mlp import layers
from sira_mi.fields.sdf import SdfField
from sira_mi.training.prior import whitening
from sira_mi.training.sa_sm import LATENTS, NETWORKS


@dataclass(frozen=True)
class ShapeModel:
    """Networks of the SA-SM, each a flat parameter vector, and per latent the mean [dim] and the basis [dim, k] that
    takes standard normal w [k] to it."""

    architecture: AvatarArchitecture
    networks: dict[str, np.ndarray]
    means: dict[str, np.ndarray]
    bases: dict[str, np.ndarray]

    @staticmethod
    def of_training(architecture: AvatarArchitecture, parameters: Mapping[str, np.ndarray]) -> ShapeModel:
        """From the parameters of a training, latents [dim, scenes]: the Gaussian of the scenes' latents, its widest
        directions first."""
        moments = {name: whitening(parameters[name].astype(np.float64)) for name in LATENTS}
        return ShapeModel(
            architecture,
            {name: parameters[name] for name in NETWORKS},
            {name: mean.astype(np.float32) for name, (mean, _) in moments.items()},
            {name: spread.astype(np.float32) for name, (_, spread) in moments.items()},
        )

    @staticmethod
    def of_prior(prior: Avatar) -> ShapeModel:
        """From a prior, whose latents are standard normal and whose zero latent is the mean head."""
        sizes = prior.architecture.latents
        return ShapeModel(
            prior.architecture,
            {name: prior.tensors[name] for name in NETWORKS},
            {name: np.zeros(sizes[name], np.float32) for name in LATENTS},
            {name: np.eye(sizes[name], dtype=np.float32) for name in LATENTS},
        )

    def latent(self, name: str, w: np.ndarray) -> np.ndarray:
        """z [dim] of standard normal w [k]."""
        return self.means[name] + self.bases[name] @ np.asarray(w, np.float32)

    def layers_at(self, network: str, latent=None) -> list[tuple]:
        """Unpacked layers of a network, its latent a tensor [dim, S] or None."""
        return layers(self.architecture.networks[network], self.networks[network], latent)

    def field(self, latent) -> SdfField:
        """The signed distance field of the shape's latent, [dim] or [dim, S]."""
        return HeadShape(self.architecture).field({**self.networks, "z_sdf": latent})
