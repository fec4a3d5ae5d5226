"""build or resume the benchmark of portraits"""

import argparse
import time
from pathlib import Path

from sira_mi.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--collection", type=Path, required=True, help="folder whose test heads are photographed")
    parser.add_argument("--out", type=Path, required=True, help="folder of the benchmark")
    parser.add_argument("--hair", type=Path, help="folder of hair that the collection was built with")
    parser.add_argument("--ict", type=Path, help="file of ICT-FaceKit that the collection was built with")
    parser.add_argument("--valid", type=Path, help="folder of VALID avatars that the collection was built with")
    parser.add_argument("--meshes", type=Path, help="folder of meshes that the collection was built with")
    parser.add_argument("--hdri", type=Path, help="folder of .exr maps for the outdoor lights; else sun and sky")
    parser.add_argument("--sources", nargs="+", metavar="NAME", help="only these of the collection's sources")
    parser.add_argument("--primary", action="store_true", help="one light of each head instead of three")
    parser.add_argument(
        "--split", choices=("test", "train"), default="test", help="train: for `skin` and `landmarks`, not for scores"
    )
    parser.add_argument("--heads", type=int, default=12, metavar="N", help="how many heads (default: 12)")
    parser.add_argument("--size", type=int, default=512, metavar="N", help="of a photo, pixels (default: 512)")
    parser.add_argument("--samples", type=int, default=256, metavar="N", help="paths a pixel, a power of 4")
    parser.add_argument("--workers", type=int, default=1, help="processes")


def run(arguments: argparse.Namespace) -> None:
    """Builds the benchmark that the command line describes and prints a summary."""
    from studies.portraits.benchmark import build_benchmark
    from studies.portraits.benchmark_photo import PhotoSettings
    from studies.portraits.benchmark_plan import BenchmarkSettings, select_sources

    for name in ("workers", "heads"):
        if getattr(arguments, name) < 1:
            raise InputError(f"--{name} must be at least 1")
    if not 64 <= arguments.size <= 4096:
        raise InputError("--size must be 64 to 4096 pixels")
    if arguments.samples not in (1, 4, 16, 64, 256, 1024):
        raise InputError("--samples must be a power of 4 up to 1024")
    data = {name: getattr(arguments, name) for name in ("hair", "ict", "valid", "meshes")}
    sources = select_sources(arguments.collection, arguments.split, arguments.sources, data)
    start = time.monotonic()
    settings = BenchmarkSettings(
        identities=arguments.heads,
        split=arguments.split,
        primary_only=arguments.primary,
        photo=PhotoSettings(size=arguments.size, samples=arguments.samples),
    )
    entries = build_benchmark(arguments.collection, arguments.out, sources, arguments.hdri, arguments.workers, settings)
    heads = len({entry["identity"] for entry in entries})
    hair = len({entry["identity"] for entry in entries if entry["hair"]})
    print(
        f"{arguments.out}: {len(entries)} portraits of {heads} heads, {hair} of them with hair, "
        f"after {time.monotonic() - start:.0f} s"
    )
