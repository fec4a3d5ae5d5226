"""fit photos without truth, and draw a sheet of each to look at"""

import argparse
from pathlib import Path

from sira_mi.errors import InputError

LIGHTS = Path(__file__).parents[3] / "scenes" / "lights"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("photos", nargs="*", type=Path, metavar="PHOTO", help="beside the portrait of scikit-image")
    parser.add_argument("--out", type=Path, required=True, help="folder of the sheets and fits; fits there are used")
    parser.add_argument(
        "--lights",
        nargs=2,
        type=Path,
        default=(LIGHTS / "studio.exr", LIGHTS / "key_fill_rim.json"),
        metavar="FILE",
        help=".exr environments or .json lobes (default: those of scenes/lights)",
    )
    parser.add_argument("--quality", choices=("draft", "standard", "high"), default="draft", help="(default: draft)")
    parser.add_argument("--prior", type=Path, help="prior.safetensors (default: the shipped one)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")


def run(arguments: argparse.Namespace) -> None:
    """Writes a sheet for each photo; a photo that fails is named, and the others go on."""
    from studies.portraits.real import EXAMPLE, RealSettings, show_photo

    names = [photo.stem for photo in arguments.photos]
    if len({EXAMPLE, *names}) <= len(names):
        raise InputError(f"two photos have one name, or one is named {EXAMPLE}; their sheets would be one: rename one")
    settings = RealSettings(tuple(arguments.lights), arguments.quality, arguments.prior, arguments.variant)
    for photo in (None, *arguments.photos):
        try:
            print(f"{show_photo(photo, arguments.out, settings)} written", flush=True)
        except InputError as error:
            print(f"failed: {error}", flush=True)
