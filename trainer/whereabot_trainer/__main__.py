"""The command line: `python -m whereabot_trainer COMMAND`."""

import argparse

from . import golden


def main(argv=None):
    parser = argparse.ArgumentParser(prog="whereabot_trainer", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    command = commands.add_parser("golden", help="write the golden files of the engine's tests")
    command.add_argument("--out", required=True, metavar="DIR", help="where the files go")
    command.set_defaults(run=lambda args: golden.write_golden(args.out))
    args = parser.parse_args(argv)
    args.run(args)


if __name__ == "__main__":
    main()
