"""`python -m sira_mi.training shape|appearance --collection DIR --out DIR`:
trains the statistical models on a collection.

`shape` trains the SA-SM and writes `shape.checkpoint`; `appearance` trains the AF-SM on top of it and writes
`prior.safetensors`, which a fit takes with `--prior`. Both write a log and pictures, and resume from their checkpoints.
"""

from pathlib import Path

from sira_mi.errors import CommandParser, InputError, run_command


def main() -> None:
    parser = CommandParser(prog="python -m sira_mi.training", description="Trains the statistical models.")
    parser.add_argument("model", choices=("shape", "appearance"))
    parser.add_argument(
        "--collection", type=Path, required=True, help="folder of python -m sira_mi.training.collection build"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for checkpoints, logs, pictures and the prior")
    parser.add_argument(
        "--sources", nargs="+", default=[], metavar="NAME", help="scenes of these sources alone (default: all)"
    )
    parser.add_argument("--steps", type=int, help="number of steps (default: the model's)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--without", metavar="TERM", help="loss term to leave out: its weight becomes zero")
    parser.add_argument(
        "--architecture",
        nargs="+",
        default=[],
        metavar="NAME=VALUE",
        help="sizes of the networks, e.g. sdf_width=64 (default: those of AvatarArchitecture)",
    )
    parser.add_argument("--picture-steps", type=int, default=1000, metavar="N", help="steps between pictures")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    arguments = parser.parse_args()
    if (arguments.steps is not None and arguments.steps < 1) or arguments.picture_steps < 1:
        raise InputError("--steps and --picture-steps are at least 1")

    from sira_mi.files import hold_folder
    from sira_mi.variants import set_variant

    set_variant(arguments.variant)
    from sira_mi.training.train import parse_sizes, train_appearance, train_shape

    train = train_shape if arguments.model == "shape" else train_appearance
    with hold_folder(arguments.out):
        train(
            arguments.collection,
            arguments.out,
            sources=arguments.sources,
            steps=arguments.steps,
            seed=arguments.seed,
            without=arguments.without,
            sizes=parse_sizes(arguments.architecture),
            picture_steps=arguments.picture_steps,
        )


if __name__ == "__main__":
    run_command(main)
