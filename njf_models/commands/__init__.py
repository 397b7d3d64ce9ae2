"""The subcommands of `njf`: one file each, with `add_parser(subparsers)` and `run(options)`."""

from __future__ import annotations


class CommandError(Exception):
    """Something the user can understand and mend; shown as one line, exit code 1."""


class UsageError(CommandError):
    """Options that make no sense together; exit code 2."""
