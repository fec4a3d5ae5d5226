"""`python -m sira_mi.fit PHOTO --out FOLDER`: fits an avatar to one portrait photo."""

from pathlib import Path

from sira_mi.errors import CommandParser, InputError, run_command


def main() -> int:
    parser = CommandParser(prog="python -m sira_mi.fit", description="Fits an avatar to one portrait photo.")
    parser.add_argument(
        "photo", nargs="?", type=Path, help="portrait photo: JPEG, PNG, TIFF, WebP, HEIC, AVIF, ... or linear EXR"
    )
    parser.add_argument("--example", action="store_true", help="fit the public-domain portrait of scikit-image instead")
    parser.add_argument("--out", type=Path, default=Path("avatar"), help="folder for the avatar (default: avatar)")
    parser.add_argument("--quality", choices=("draft", "standard", "high"), default="standard")
    parser.add_argument("--seed", type=int, default=0, help="of everything random; the same seed repeats a fit")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint in the output folder")
    parser.add_argument(
        "--polish",
        action="store_true",
        help="at last refine albedo and light by path tracing; repeats up to the last bits only",
    )
    parser.add_argument("--mask", type=Path, help="foreground mask image of the photo's size")
    parser.add_argument("--camera", type=Path, help="camera.json: K, world_to_camera, width, height (OpenCV)")
    parser.add_argument("--face", type=int, help="which face, counted from 0 by size (default: the largest)")
    parser.add_argument("--prior", type=Path, help="prior.safetensors instead of the shipped one")
    parser.add_argument("--explain", action="store_true", help="say what the stages leave out, and measure it")
    parser.add_argument("--keep-all", action="store_true", help="leave nothing out")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant, e.g. cuda_ad_rgb")
    arguments = parser.parse_args()
    if (arguments.photo is None) == (not arguments.example):
        raise InputError("give one photo, or --example")
    if arguments.seed < 0:
        raise InputError(f"--seed is {arguments.seed}; it must not be negative")

    from sira_mi.fit.fit import FitRequest, fit_photo

    return fit_photo(FitRequest(**vars(arguments)))


if __name__ == "__main__":
    run_command(main)
