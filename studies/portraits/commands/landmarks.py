"""measure and correct landmarks of photos and of the prior"""

import argparse
from pathlib import Path

from sira_mi.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--collection", type=Path, required=True, help="whose training scans the prior is fitted to")
    parser.add_argument("--benchmark", type=Path, required=True, help="portraits of training heads")
    parser.add_argument("--prior", type=Path, help="prior.safetensors (default: the shipped one)")
    parser.add_argument(
        "--out", type=Path, required=True, help="folder for prior.safetensors and head_landmarks.safetensors"
    )
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")


def run(arguments: argparse.Namespace) -> None:
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
    _make_folder(arguments.out)
    measure_landmarks.fit_correction(observations).save(arguments.out / CORRECTION.name)
    save_avatar(arguments.out / "prior.safetensors", fit_landmark_model.add_landmark_model(prior, places))
    print(
        f"{len(observations)} portraits of {len({o.head for o in observations})} heads, {len(blind)} without a face: "
        f"found landmarks {100 * found:.2f}% of the face off, corrected {100 * corrected:.2f}%"
    )
    print(f"{len(places.true)} scans: the prior's landmarks {placed:.1f} mm off, modelled {modelled:.1f} mm")


def _make_folder(folder: Path) -> None:
    """Raises InputError when it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {folder}: {error.strerror}; choose another --out") from error
