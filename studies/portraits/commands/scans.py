"""fit a prior's latents to scans of real faces: a check of the prior, never of settings"""

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scans", type=Path, required=True, help="folder of .npz files with v (millimetres) and f")
    parser.add_argument("--prior", type=Path, help="prior.safetensors (default: the shipped one)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")


def run(arguments: argparse.Namespace) -> None:
    """Prints the distance of each face from the mean head and from the fitted one."""
    import numpy as np

    from sira_mi.variants import set_variant

    set_variant(arguments.variant)
    from sira_mi.avatar.file import load_prior
    from sira_mi.portrait.landmarks import NOSE_TIP
    from sira_mi.training.shape_model import ShapeModel
    from studies.markdown import number, table
    from studies.portraits.fit_scans import fit_scans, read_scans

    prior = load_prior(arguments.prior)
    rows = fit_scans(ShapeModel.of_prior(prior), prior.tensors["landmarks"][NOSE_TIP], read_scans(arguments.scans))
    columns = ("mean_head", "fitted")
    lines = [[row["name"], *(number(row[name]) for name in columns)] for row in rows]
    means = [number(float(np.mean([row[name] for row in rows]))) for name in columns]
    print(table(("face, mm", "mean head", "fitted"), [*lines, ["all", *means]]))
