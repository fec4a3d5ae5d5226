"""measure how well photos predict the level of their skin's albedo"""

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--benchmark", type=Path, required=True, help="portraits of training heads")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")


def run(arguments: argparse.Namespace) -> None:
    """Prints how well the cues of `sira_mi.fit.skin` predict the skin's albedo, over a benchmark's portraits."""
    import numpy as np

    from sira_mi.variants import set_variant

    set_variant(arguments.variant)
    from studies.portraits.measure_skin import estimate, observe

    observations, blind = observe(arguments.benchmark)
    found = estimate(observations)
    spread = np.std(np.log([o.luminance for o in observations]))
    print(f"{len(observations)} portraits, log of the skin's luminance within {spread:.2f}; unseen: {len(blind)}")
    print(f"by skin: error {found.error_by_skin:.2f}; by skin and eyes: error {found.error:.2f}, with")
    print(", ".join(f"{name} {value:.2f}" for name, value in vars(found.level).items()))
