"""`python -m studies.portraits.fit_by_method METHOD PHOTO --out FOLDER`: fits an avatar by one of the methods that are
compared, `studies.portraits.methods`.

It writes `FOLDER/avatar` as `python -m sira_mi.fit` does, and `FOLDER/tensors.safetensors`, from which the methods that
continue from it start (`--after`).
"""

import argparse
import tempfile
import time
from pathlib import Path

from sira_mi.errors import CommandParser, run_command
from studies.portraits.methods import BY_NAME


def fit_by_method(arguments: argparse.Namespace) -> None:
    """Fits and writes as the command line says. Raises InputError for a photo that cannot be fitted."""
    from sira_mi.avatar.file import load_prior, save_avatar
    from sira_mi.fit.driver import Progress
    from sira_mi.fit.fit import assemble_avatar, fit_portrait, write_folder
    from sira_mi.fit.settings import QUALITIES
    from sira_mi.fit.state import FitState, initial_state
    from sira_mi.optimisation.adam import read_arrays, write_arrays
    from sira_mi.portrait.portrait import PortraitSettings, make_portrait

    started = time.monotonic()
    method = BY_NAME[arguments.method]
    settings = method.settings(QUALITIES[arguments.quality])
    prior = load_prior(arguments.prior)
    portrait = make_portrait(
        arguments.photo, PortraitSettings(working_size=settings.working_size), prior.tensors["landmarks"]
    )
    if arguments.after is None:
        state = initial_state(prior, arguments.seed)
    else:
        state = FitState.from_arrays(read_arrays(arguments.after / "tensors.safetensors")[0])
    progress = Progress(method.start(prior, state, arguments.seed))
    with tempfile.TemporaryDirectory() as work:
        task = method.task(portrait, prior, arguments.prior, settings, Path(work), settings.plan())
        fit_portrait(task, progress, arguments.seed)
    out = arguments.out / "avatar"
    out.mkdir(parents=True, exist_ok=True)
    write_arrays(arguments.out / "tensors.safetensors", progress.state.arrays(), {})
    avatar = assemble_avatar(prior, progress, settings, portrait.exposure)
    save_avatar(out / "avatar.safetensors", avatar)
    report = {
        "method": method.name,
        "quality": arguments.quality,
        "seed": arguments.seed,
        "seconds": {name: round(seconds, 2) for name, seconds in progress.seconds.items()},
        "losses": progress.losses,
        "settings": settings.describe(),
        "notes": [*portrait.notes, *progress.notes],
    }
    write_folder(out, task.pose_portrait(progress.state), avatar, settings, report, started)


def main() -> None:
    parser = CommandParser(
        prog="python -m studies.portraits.fit_by_method", description="Fits an avatar by one of the methods compared."
    )
    parser.add_argument("method", choices=BY_NAME)
    parser.add_argument("photo", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--after", type=Path, help="output folder of the method that this one continues from")
    parser.add_argument("--quality", choices=("draft", "standard", "high"), default="draft")
    parser.add_argument("--prior", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    arguments = parser.parse_args()

    from sira_mi.variants import set_variant

    set_variant(arguments.variant)
    fit_by_method(arguments)


if __name__ == "__main__":
    run_command(main)
