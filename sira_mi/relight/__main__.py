"""`python -m sira_mi.relight AVATAR --lights FILE --out IMAGE`: a fitted head under another light."""

from __future__ import annotations

import argparse
import math
import os
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sira_mi.errors import CommandParser, InputError, check_range, check_writable, run_command

if TYPE_CHECKING:
    from sira_mi.plugins.neural_sdf import NeuralSDF
    from sira_mi.relight.render import RelightSettings
    from sira_mi.relight.subject import Light, Subject

_DESCRIPTION = """\
Renders a fitted head under another light, and writes IMAGE.exr (linear radiance) and IMAGE.png (sRGB).

The head turns; the light and the camera stay fixed. The PNG is exposed so that 98 % of the head's pixels are at most at
0.8 of white, before sRGB, in their brightest channel; one exposure serves all frames of a turntable. --exposure sets it
instead. Two integrators:
  path  path tracing: shadows and all interreflections, with noise that falls with --spp; uses an .exr as it is
  sg    closed form (eq. 8 of SIRA): quick and without noise, with approximate shadows and one bounce; fits spherical
        Gaussians to an .exr"""
_EPILOG = """\
examples:
  python -m sira_mi.relight avatar --lights scenes/lights/studio.exr --out relit.png
  python -m sira_mi.relight avatar --integrator sg --draft --turntable 48 --out turn
  python -m sira_mi.relight avatar --compare --out check"""
_SAMPLES = {"path": 256, "sg": 8}
_MAXIMUM_SIZE = 8192
_MAXIMUM_SAMPLES = 1 << 20
_MAXIMUM_FRAMES = 9999
_COMPARED = ("sg", "path")
_ENDINGS = (".exr", ".png")
_OTHER_ENDINGS = (".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".gif", ".webp", ".hdr", ".mp4")


def image_path(text: str) -> Path:
    """The path of the option `--out`. Raises InputError when it ends as a folder's does."""
    if text.endswith(("/", os.sep)):
        raise InputError(f"--out {text} names a folder; add the name of a picture")
    return Path(text)


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="python -m sira_mi.relight",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("avatar", type=Path, metavar="AVATAR", help="output folder of a fit, or an avatar.safetensors")
    parser.add_argument(
        "--lights", type=Path, metavar="FILE", help=".exr environment or .json lobes (default: the light of the photo)"
    )
    parser.add_argument("--integrator", choices=("sg", "path"), default="path", help="(default: path)")
    parser.add_argument("--spp", type=int, metavar="N", help="samples a pixel (default: 256, and 8 with sg)")
    parser.add_argument("--yaw", type=float, default=0.0, metavar="DEG", help="turns the head to its left (default: 0)")
    parser.add_argument(
        "--view",
        choices=("head", "photo"),
        help="head: a square around the head; photo: the frame of the photo (default: head, and photo with --compare)",
    )
    parser.add_argument(
        "--out",
        type=image_path,
        required=True,
        metavar="IMAGE",
        help="both files have this name, ending in .exr and .png",
    )
    parser.add_argument(
        "--size", type=int, metavar="N", help="longer side in pixels (default: that of the fit, or 512)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the samples; the same seed repeats a picture")
    parser.add_argument("--turntable", type=int, metavar="N", help="N frames of a full turn, IMAGE_000, IMAGE_001, ...")
    parser.add_argument("--exposure", type=float, metavar="STOPS", help="of the PNG; 0 shows radiance 1 as white")
    parser.add_argument("--background", action="store_true", help="show the environment behind the head")
    parser.add_argument(
        "--exact", action="store_true", help="path: evaluate the albedo networks at every hit; slow (default: a vertex)"
    )
    parser.add_argument(
        "--draft", action="store_true", help="sg: shade the mesh instead of the field, once a pixel; quick, less detail"
    )
    parser.add_argument(
        "--compare", action="store_true", help="render with both integrators under the same lobes; print the difference"
    )
    parser.add_argument(
        "--explain", action="store_true", help="say what is left out, and measure the error of each on a small picture"
    )
    parser.add_argument("--keep-all", action="store_true", help="leave nothing out; with path that is --exact, too")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant, e.g. cuda_ad_rgb")
    return parser


def _check(options: argparse.Namespace) -> None:
    check_range("spp", options.spp, 1, _MAXIMUM_SAMPLES)
    check_range("size", options.size, 1, _MAXIMUM_SIZE)
    check_range("turntable", options.turntable, 1, _MAXIMUM_FRAMES)
    check_range("seed", options.seed, 0, 2**32 - 1)
    check_range("exposure", options.exposure, -30, 30)
    if options.exact and options.integrator == "sg" and not options.compare:
        raise InputError("--exact belongs to --integrator path; closed-form shading is exact without --draft")
    if options.draft and (options.integrator == "path" or options.compare):
        raise InputError("--draft belongs to --integrator sg alone")
    if not math.isfinite(options.yaw):
        raise InputError(f"--yaw is {options.yaw}; it must be a number of degrees")
    if options.compare and options.turntable:
        raise InputError("--compare and --turntable do not go together; give one of them")
    if options.compare and (options.explain or options.keep_all):
        raise InputError("--compare leaves nothing out; --explain and --keep-all do not go with it")


def output_stem(out: Path) -> Path:
    """The path of an image without its ending. Raises InputError for other image formats, and when files cannot be
    written there."""
    if out.suffix.lower() in _OTHER_ENDINGS:
        raise InputError(f"--out ends in {out.suffix}; give .png, .exr or no ending, both files are written")
    stem = out.with_suffix("") if out.suffix.lower() in _ENDINGS else out
    if not stem.name or out.is_dir():
        raise InputError(f"--out {out} names a folder; add the name of a picture")
    check_writable(stem.parent)
    return stem


def picture_stems(stem: Path, options: argparse.Namespace) -> list[Path]:
    """The paths of all pictures that the command writes, without their endings."""
    if options.compare:
        return [stem.with_name(f"{stem.name}_{name}") for name in _COMPARED]
    if not options.turntable:
        return [stem]
    digits = count_digits(options.turntable)
    return [stem.with_name(f"{stem.name}_{frame:0{digits}d}") for frame in range(options.turntable)]


def count_digits(frames: int) -> int:
    """Of the number of a turntable's frame in its file name."""
    return max(3, len(str(frames - 1)))


def check_pictures(stems: list[Path], options: argparse.Namespace) -> None:
    """Raises InputError when a picture cannot be written, or would overwrite an input or a file that is not of this
    program, such as the photo or an environment."""
    from sira_mi.files import check_outputs, check_own

    pictures = [stem.with_name(stem.name + ending) for stem in stems for ending in _ENDINGS]
    check_outputs(pictures, (options.avatar, options.lights))
    check_own(pictures)


def video_command(stem: Path, frames: int) -> str:
    """The ffmpeg command for a turntable's pictures, as a shell takes it. The video has even sides, as players need."""
    place = str(stem.absolute())
    command = ["ffmpeg", "-framerate", "24", "-i", f"{place.replace('%', '%%')}_%0{count_digits(frames)}d.png"]
    command += ["-frames:v", str(frames), "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", f"{place}.mp4"]
    return subprocess.list2cmdline(command) if sys.platform == "win32" else shlex.join(command)


def _plan_pictures(
    subject: Subject, light: Light, settings: RelightSettings, yaws: list[float], options: argparse.Namespace
) -> tuple[RelightSettings, NeuralSDF]:
    """The settings of the pictures at `yaws`, degrees, and their head: what does not matter is left out, unless
    `--keep-all`. `--explain` prints the decisions."""
    from sira_mi.decisions import explain
    from sira_mi.relight.leave_out import plan_relight
    from sira_mi.relight.measure import measure_plan
    from sira_mi.relight.render import load_head

    everything = replace(settings, exact=settings.integrator == "path")
    if options.keep_all and not options.explain:
        return everything, load_head(subject, everything)
    print("baking the head and looking for what it can leave out", file=sys.stderr)
    shape = load_head(subject, settings)
    plan = plan_relight(subject, light, shape, everything, yaws, exact=settings.exact)
    if options.explain:
        print("measuring what is left out", file=sys.stderr)
        print(explain(measure_plan(plan, subject, light, everything, yaws[0])), flush=True)
    chosen = (plan.keep_all() if options.keep_all else plan).apply(everything)
    if (chosen.exact, chosen.specular) != (settings.exact, settings.specular):
        shape = load_head(subject, chosen)
    return chosen, shape


def main(arguments: list[str] | None = None) -> int:
    """Runs the command on `arguments` (default: the process's). Raises InputError for anything a user can mend."""
    options = _parser().parse_args(arguments)
    _check(options)
    stem = output_stem(options.out)
    stems = picture_stems(stem, options)
    check_pictures(stems, options)

    from tqdm import tqdm

    from sira_mi.export.scene import orbit
    from sira_mi.files import read_exr, write_exr
    from sira_mi.relight.compare import CLOSED_FORM_SAMPLES, compare
    from sira_mi.relight.pictures import meter_exposure
    from sira_mi.relight.render import (
        RelightSettings,
        head_pixels,
        load_head,
        load_scene,
        render_passes,
        with_ending,
        write_preview,
    )
    from sira_mi.relight.subject import read_light, read_subject
    from sira_mi.variants import set_variant

    set_variant(options.variant)
    settings = RelightSettings(
        integrator=options.integrator,
        samples=options.spp or _SAMPLES["path" if options.compare else options.integrator],
        seed=options.seed,
        exact=options.exact,
        background=options.background,
        shared=options.draft,
        on_mesh=options.draft,
        extra_channels=options.compare,
    )
    subject = read_subject(options.avatar, options.size)
    if options.view == "head" or not (options.view or options.compare):
        subject = subject.frame_head()
    lobes = options.compare or options.integrator == "sg"
    if options.lights and lobes and options.lights.suffix.lower() == ".exr":
        print(f"fitting spherical Gaussians to {options.lights}", file=sys.stderr)
    light = read_light(options.lights, subject.avatar, lobes=lobes)

    if options.compare:
        print("baking the head", file=sys.stderr)
        shape = load_head(subject, replace(settings, integrator="path"))
        with tqdm(total=settings.samples + CLOSED_FORM_SAMPLES, unit="spp", disable=None) as bar:
            result = compare(shape, subject.camera, light, options.yaw, settings, bar.update)
        exposure = meter_exposure(result.traced[result.mask]) if options.exposure is None else options.exposure
        for picture, image in zip(stems, (result.closed_form, result.traced), strict=True):
            write_exr(with_ending(picture, ".exr"), image)
            write_preview(picture, image, exposure)
        print(f"sg   {result.seconds[0]:7.1f} s  {CLOSED_FORM_SAMPLES} samples a pixel")
        print(f"path {result.seconds[1]:7.1f} s  {settings.samples} samples a pixel")
        print(
            f"sg against path, inside the head: PSNR {result.psnr:.1f} dB, "
            f"mean error {100 * result.relative_error:.1f} %, mean brightness {100 * result.bias:+.1f} %"
        )
        return 0

    yaws = [options.yaw + 360 * frame / len(stems) for frame in range(len(stems))]
    settings, shape = _plan_pictures(subject, light, settings, yaws, options)
    exposures = []
    with tqdm(total=len(stems) * settings.samples, desc="rendering", unit="spp", disable=None) as bar:
        for frame, yaw in zip(stems, yaws, strict=True):
            scene = load_scene(shape, subject.camera, light, yaw, settings)
            radiance = render_passes(scene, settings, bar.update)[..., :3]
            exposures.append(meter_exposure(head_pixels(radiance, shape, orbit(subject.camera, yaw))))
            write_exr(with_ending(frame, ".exr"), radiance)
    exposure = min(exposures) if options.exposure is None else options.exposure
    for frame in stems:
        write_preview(frame, read_exr(with_ending(frame, ".exr"))[0], exposure)
    print(f"PNG: --exposure {exposure:.2f}")
    if options.turntable:
        print(f"for a video: {video_command(stem, options.turntable)}")
    return 0


if __name__ == "__main__":
    run_command(main)
