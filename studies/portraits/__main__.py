"""`python -m studies.portraits build|fit|page|skin|landmarks …`: portraits of known heads, and how close fits come.

`build` renders portraits of the collection's test heads under known light; it resumes. `fit` fits and scores them and
writes the figures, `docs/data/portraits.json`, the picture and the page, `docs/results.md`; `page` writes the page from
the figures alone. `skin` and `landmarks` use portraits of training heads: `skin` measures how the radiance of skin and
eyes predicts the skin's albedo, the values of `sira_mi.fit.skin`; `landmarks` measures the errors of detected landmarks
and of the prior's landmarks, and writes the corrections of both.
"""

import argparse
import time
from pathlib import Path

from sira_mi.errors import CommandParser, InputError, run_command
from studies.cache import write_json
from studies.data import read_figures, write_figures


def main() -> None:
    parser = CommandParser(
        prog="python -m studies.portraits",
        description="Portraits of known heads, and how close fits come.",
    )
    commands = parser.add_subparsers(dest="command", required=True)
    portraits = commands.add_parser("build", help="build or resume the benchmark of portraits")
    portraits.add_argument("--collection", type=Path, required=True, help="folder whose test heads are photographed")
    portraits.add_argument("--out", type=Path, required=True, help="folder of the benchmark")
    portraits.add_argument("--hair", type=Path, help="folder of hair that the collection was built with")
    portraits.add_argument("--ict", type=Path, help="file of ICT-FaceKit that the collection was built with")
    portraits.add_argument("--valid", type=Path, help="folder of VALID avatars that the collection was built with")
    portraits.add_argument("--meshes", type=Path, help="folder of meshes that the collection was built with")
    portraits.add_argument("--hdri", type=Path, help="folder of .exr maps for the outdoor lights; else sun and sky")
    portraits.add_argument("--sources", nargs="+", metavar="NAME", help="only these of the collection's sources")
    portraits.add_argument("--primary", action="store_true", help="one light of each head instead of three")
    portraits.add_argument(
        "--split", choices=("test", "train"), default="test", help="train: for `skin` and `landmarks`, not for scores"
    )
    portraits.add_argument("--heads", type=int, default=12, metavar="N", help="how many heads (default: 12)")
    portraits.add_argument("--size", type=int, default=512, metavar="N", help="of a photo, pixels (default: 512)")
    portraits.add_argument("--samples", type=int, default=256, metavar="N", help="paths a pixel, a power of 4")
    portraits.add_argument("--workers", type=int, default=1, help="processes")
    skin = commands.add_parser("skin", help="measure how well photos predict the level of their skin's albedo")
    skin.add_argument("--benchmark", type=Path, required=True, help="portraits of training heads")
    skin.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    landmarks = commands.add_parser("landmarks", help="measure and correct landmarks of photos and of the prior")
    landmarks.add_argument("--collection", type=Path, required=True, help="whose training scans the prior is fitted to")
    landmarks.add_argument("--benchmark", type=Path, required=True, help="portraits of training heads")
    landmarks.add_argument("--prior", type=Path, help="prior.safetensors (default: the shipped one)")
    landmarks.add_argument(
        "--out", type=Path, required=True, help="folder for prior.safetensors and head_landmarks.safetensors"
    )
    landmarks.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    fits = commands.add_parser("fit", help="fit the benchmark's portraits, score them, write figures and page")
    fits.add_argument("--benchmark", type=Path, required=True)
    fits.add_argument("--runs", type=Path, required=True, help="folder of the fits; finished ones are kept")
    pages = commands.add_parser("page", help="write the page from its figures")
    for command in (fits, pages):
        command.add_argument("--out", type=Path, default=Path("docs"), help="folder of the page (default: docs)")
    fits.add_argument("--quality", choices=("draft", "standard", "high"), default="standard", help="of the shipped fit")
    fits.add_argument(
        "--ablations", choices=("draft", "standard", "high"), default="draft", help="quality of all methods"
    )
    fits.add_argument("--methods", nargs="+", metavar="NAME", help="methods to compare (default: all, a.3 to b.7)")
    fits.add_argument(
        "--portraits", nargs="+", default=(), metavar="NAME", help="portraits (default: the primary ones)"
    )
    fits.add_argument("--all-lights", action="store_true", help="every portrait, not one of each head")
    fits.add_argument("--prior", type=Path, help="prior.safetensors (default: the shipped one)")
    fits.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    arguments = parser.parse_args()
    run = {
        "build": make_benchmark,
        "fit": compare_fits,
        "page": write_results,
        "skin": print_skin_level,
        "landmarks": correct_landmarks,
    }
    run[arguments.command](arguments)


def compare_fits(arguments: argparse.Namespace) -> None:
    """Fits and scores the benchmark's portraits as the command line says; writes figures, picture and page."""
    from sira_mi.avatar.file import PRIOR
    from sira_mi.variants import set_variant
    from studies.portraits.compare_methods import Comparison, compare
    from studies.portraits.methods import BY_NAME
    from studies.portraits.page import FIGURES
    from studies.portraits.picture import write_picture
    from studies.portraits.summary import SHIPPED, summarise

    set_variant(arguments.variant)

    def rows(quality: str, methods: tuple[str, ...]) -> list[dict]:
        comparison = Comparison(
            arguments.benchmark,
            arguments.runs / quality,
            quality,
            methods,
            arguments.prior or PRIOR,
            primary=not arguments.all_lights,
            only=tuple(arguments.portraits),
            variant=arguments.variant,
        )
        found = compare(comparison)
        write_json(arguments.runs / quality / "rows.json", found)
        return found

    ablations = rows(arguments.ablations, tuple(arguments.methods or BY_NAME))
    shipped = rows(arguments.quality, (SHIPPED,))
    figures = summarise(shipped, ablations, arguments.quality, arguments.ablations)
    write_figures(arguments.out / FIGURES, figures)
    picture = arguments.out / "images" / "results.png"
    write_picture(shipped, arguments.benchmark, arguments.runs / arguments.quality, picture)
    write_results(arguments)


def write_results(arguments: argparse.Namespace) -> None:
    """Writes the page from its figures."""
    from studies.portraits.page import FIGURES, write_page

    print(f"{write_page(read_figures(arguments.out / FIGURES), arguments.out)} written")


def print_skin_level(arguments: argparse.Namespace) -> None:
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


def correct_landmarks(arguments: argparse.Namespace) -> None:
    """Writes the correction of detected landmarks and the prior with its landmark model; prints the errors of both."""
    from sira_mi.variants import set_variant

    set_variant(arguments.variant)
    from sira_mi.avatar.file import load_avatar, save_avatar
    from sira_mi.portrait.head_landmarks import CORRECTION
    from sira_mi.training.scenes import load_training_scenes
    from studies.portraits import measure_landmarks
    from studies.priors import fit_landmark_model

    prior = fit_landmark_model.without_landmark_model(load_avatar(arguments.prior))
    observations, blind = measure_landmarks.observe(arguments.benchmark)
    found, corrected = measure_landmarks.measure_held_out_errors(observations)
    places = fit_landmark_model.place_landmarks(prior, load_training_scenes(arguments.collection))
    placed, modelled = fit_landmark_model.measure_held_out_errors(prior, places)
    make_folder(arguments.out)
    measure_landmarks.fit_correction(observations).save(arguments.out / CORRECTION.name)
    save_avatar(arguments.out / "prior.safetensors", fit_landmark_model.add_landmark_model(prior, places))
    print(
        f"{len(observations)} portraits of {len({o.head for o in observations})} heads, {len(blind)} without a face: "
        f"found landmarks {100 * found:.2f}% of the face off, corrected {100 * corrected:.2f}%"
    )
    print(f"{len(places.true)} scans: the prior's landmarks {placed:.1f} mm off, modelled {modelled:.1f} mm")


def make_folder(folder: Path) -> None:
    """Raises InputError when it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {folder}: {error.strerror}; choose another --out") from error


def make_benchmark(arguments: argparse.Namespace) -> None:
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


if __name__ == "__main__":
    run_command(main)
