"""The subcommands of `njf`: one file each, with `add_parser(subparsers)` and `run(options)`."""

from __future__ import annotations


class CommandError(Exception):
    """Something the user can understand and mend; shown as one line, exit code 1."""


class UsageError(CommandError):
    """Options that make no sense together; exit code 2."""


_EXTRAS = {
    "uv": ("PIL", "safetensors", "tqdm", "trimesh"),
    "view": ("matplotlib", "viser"),
    "train": ("joblib", "lightning", "manifold3d", "tensorboard", "threadpoolctl"),
}


def how_to_install(error: ModuleNotFoundError) -> str:
    """What to do about a package that a command misses."""
    package = (error.name or str(error)).split(".")[0]
    extra = next((extra for extra, names in _EXTRAS.items() if package in names), None)
    return f"{package} is not installed: pip install " + (
        f"'diffpoisson[{extra}]'" if extra else package
    )
