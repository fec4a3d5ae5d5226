"""The sections of the page in order: a new subject is a module with `MEASURES`, added here and to `template.md`."""

from pathlib import Path

from studies.stability import fits, sampling, spherical_gaussians, tracing
from studies.stability.rows import Measure

NUMERICS: dict[str, tuple[Measure, ...]] = {
    "spherical_gaussians": spherical_gaussians.MEASURES,
    "sampling": sampling.MEASURES,
    "tracing": tracing.MEASURES,
}


def list_sections(work: Path) -> dict[str, tuple[Measure, ...]]:
    """All of them with the fits, which are kept in the folder `work`."""
    return {**NUMERICS, "fits": fits.list_measures(work)}
