"""build or resume the benchmark of portraits"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

from sira_mi.errors import InputError

# What each kind of benchmark is made of.
NEEDED = {"foreign": ("valid", "morphs", "hair", "hdri"), "own": ("collection",)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--kind", choices=("foreign", "own"), default="own", help="VALID avatars, or heads of a collection (default)"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the benchmark")
    parser.add_argument("--hdri", type=Path, help="folder of .exr maps, for relighting and outdoor photos")
    parser.add_argument("--valid", type=Path, help="folder of VALID avatars")
    parser.add_argument("--morphs", type=Path, help="foreign: folder of the avatars' morphs")
    parser.add_argument("--hair", type=Path, help="folder of hair; own: that the collection was built with")
    parser.add_argument("--collection", type=Path, help="own: folder whose heads are photographed")
    parser.add_argument("--ict", type=Path, help="own: file of ICT-FaceKit that the collection was built with")
    parser.add_argument("--meshes", type=Path, help="own: folder of meshes that the collection was built with")
    parser.add_argument("--sources", nargs="+", metavar="NAME", help="own: only these of the collection's sources")
    parser.add_argument("--primary", action="store_true", help="own: one light of each head instead of three")
    parser.add_argument(
        "--split", choices=("test", "train"), default="test", help="own, train: for `skin` and `landmarks`, not scores"
    )
    parser.add_argument("--heads", type=int, metavar="N", help="how many heads (default: 12; foreign: 28)")
    parser.add_argument("--portraits", type=int, metavar="N", help="foreign: the first N, from both halves in turns")
    parser.add_argument("--size", type=int, default=512, metavar="N", help="of a photo, pixels (default: 512)")
    parser.add_argument("--samples", type=int, default=256, metavar="N", help="paths a pixel, a power of 4")
    parser.add_argument("--view-samples", type=int, default=64, metavar="N", help="the same of relit and turned views")
    parser.add_argument("--noise", type=int, default=0, metavar="N", help="other numbers give other noise")
    parser.add_argument("--workers", type=int, default=1, help="processes")


def run(arguments: argparse.Namespace) -> None:
    """Builds the benchmark that the command line describes and prints a summary."""
    from studies.portraits.benchmark import build_benchmark
    from studies.portraits.benchmark_plan import BenchmarkSettings, plan_own, select_sources
    from studies.portraits.foreign_plan import FOREIGN, plan_foreign

    for name in ("workers", "heads", "portraits"):
        if (number := getattr(arguments, name)) is not None and number < 1:
            raise InputError(f"--{name} must be at least 1")
    if not 64 <= arguments.size <= 4096:
        raise InputError("--size must be 64 to 4096 pixels")
    if not {arguments.samples, arguments.view_samples} <= {1, 4, 16, 64, 256, 1024}:
        raise InputError("--samples and --view-samples must be powers of 4 up to 1024")
    if arguments.noise < 0:
        raise InputError("--noise must not be negative")
    if missing := [name for name in NEEDED[arguments.kind] if getattr(arguments, name) is None]:
        raise InputError(f"--kind {arguments.kind} needs --{missing[0]}")
    start = time.monotonic()
    settings = FOREIGN if arguments.kind == "foreign" else BenchmarkSettings()
    settings = replace(
        settings,
        identities=arguments.heads or settings.identities,
        split=arguments.split,
        primary_only=arguments.primary,
        photo=replace(
            settings.photo,
            size=arguments.size,
            samples=arguments.samples,
            view_samples=arguments.view_samples,
            noise=arguments.noise,
        ),
    )
    if settings.kind == "foreign":
        sittings = plan_foreign(arguments.valid, arguments.morphs, arguments.hair, arguments.hdri, settings)
        sittings = sittings[: arguments.portraits]
    else:
        data = {name: getattr(arguments, name) for name in ("hair", "ict", "valid", "meshes")}
        sources = select_sources(arguments.collection, arguments.split, arguments.sources, data)
        sittings = plan_own(arguments.collection, sources, arguments.hdri, settings)
    entries = build_benchmark(sittings, arguments.out, settings, arguments.workers)
    heads = len({entry["identity"] for entry in entries})
    hair = len({entry["identity"] for entry in entries if entry["hair"]})
    print(
        f"{arguments.out}: {len(entries)} portraits of {heads} heads, {hair} of them with hair, "
        f"after {time.monotonic() - start:.0f} s"
    )
