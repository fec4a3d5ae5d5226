"""The page's sections in order: a new subject is a module with a `SECTION`, added here."""

from sira_mi.stability import sampling, spherical_gaussians, tracing

SECTIONS = (spherical_gaussians.SECTION, sampling.SECTION, tracing.SECTION)
