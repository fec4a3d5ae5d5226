"""The page's sections in order, by the names of their modules: a new subject is a module with a `SECTION`, or a
`section(work)` where something is kept on disk, added here."""

from pathlib import Path

from studies.stability import fits, sampling, spherical_gaussians, tracing
from studies.stability.rows import Section

SECTIONS = {
    "spherical_gaussians": spherical_gaussians.SECTION,
    "sampling": sampling.SECTION,
    "tracing": tracing.SECTION,
}


def all_sections(work: Path) -> dict[str, Section]:
    """Those and the fits, which are kept in the folder `work`."""
    return {**SECTIONS, "fits": fits.section(work)}
