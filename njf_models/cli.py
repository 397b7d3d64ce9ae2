"""The command line `njf`: finds the subcommand, runs it, and turns errors into one line."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from importlib.util import find_spec

from njf_models.commands import CommandError, UsageError, how_to_install

# In the order of `njf --help`. Each is a module of `njf_models.commands` with
# `add_parser(subparsers)` and `run(options) -> exit code`, light to import.
COMMANDS = ("uv", "info", "view", "repose", "data", "train")

_EXIT_CODES = """\
exit codes: 0 all went well, 1 something failed, 2 wrong usage, 130 interrupted
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit code."""
    options = parser().parse_args(arguments)
    if not options.debug:
        warnings.simplefilter("ignore")
    try:
        return int(options.run(options))
    except KeyboardInterrupt:
        print(f"njf {options.command}: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of a pipe went away, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        if options.debug:
            raise
        print(f"njf {options.command}: {_one_line(error)}", file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1


def parser() -> argparse.ArgumentParser:
    """The parser of all commands that are installed."""
    top = argparse.ArgumentParser(
        prog="njf",
        description="UV maps that hold, and the networks that make them.",
        epilog=_EXIT_CODES + "\n`njf COMMAND --help` says more about each.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"njf {version('diffpoisson')}")
    subparsers = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS:
        module = f"njf_models.commands.{name}"
        if find_spec(module) is not None:
            command = importlib.import_module(module)
            subparser: argparse.ArgumentParser = command.add_parser(subparsers)
            subparser.add_argument(
                "--debug", action="store_true", help="show tracebacks and warnings"
            )
            subparser.set_defaults(run=command.run, command=name)
    return top


def _one_line(error: Exception) -> str:
    """What went wrong, in words for who typed the command."""
    if isinstance(error, CommandError):
        return str(error)
    if isinstance(error, ModuleNotFoundError):
        return how_to_install(error)
    text = " ".join(str(error).split()) or "no message"
    return f"{text} ({type(error).__name__}; --debug shows where)"


if __name__ == "__main__":
    sys.exit(main())
