"""`python -m studies.portraits build|fit|score|page|stranger|real|scans|skin|landmarks …`: portraits of known heads,
and fits to them.

`build` renders portraits of known heads under known light, of VALID avatars (`--kind foreign`) or of a collection's
test heads (`own`). `fit` makes rows, fits and baselines (`studies.portraits.rows`), and `score` scores them. All three
resume portrait by portrait. `page` writes the page, `docs/results.md`, from its figures, or measures them before.
`stranger` writes a sheet of relit heads and photos that a stranger pairs blindly, and its key. `real` draws sheets of
photos without truth, `scans` fits the prior to scans of real faces. `skin` and `landmarks` use portraits of training
heads: `skin` measures how the radiance of skin and eyes predicts the skin's albedo, which `sira_mi.fit.skin` holds;
`landmarks` measures the errors of detected landmarks and of the prior's landmarks, and writes the corrections of both.
"""

from sira_mi.errors import CommandParser, run_command
from studies.portraits.commands import build, fit, landmarks, page, real, scans, score, skin, stranger

COMMANDS = {
    "build": build,
    "fit": fit,
    "score": score,
    "page": page,
    "stranger": stranger,
    "real": real,
    "scans": scans,
    "skin": skin,
    "landmarks": landmarks,
}


def main() -> None:
    parser = CommandParser(
        prog="python -m studies.portraits",
        description="Portraits of known heads, and how close fits come.",
    )
    commands = parser.add_subparsers(dest="command", required=True)
    for name, module in COMMANDS.items():
        module.add_arguments(commands.add_parser(name, help=module.__doc__))
    arguments = parser.parse_args()
    COMMANDS[arguments.command].run(arguments)


if __name__ == "__main__":
    run_command(main)
