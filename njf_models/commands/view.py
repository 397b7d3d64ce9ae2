"""`njf view`: a mesh in the browser that follows its handles, and its UV map."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from njf_models.commands import CommandError, how_to_install

_EPILOG = """\
examples:
  njf view bunny.obj
  njf view scan.ply --port 8100

Click on the surface to put a handle there, drag its arrows and rings, and the surface follows.
Ctrl-C ends the program.
"""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Register the command."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "view",
        help="drag a mesh by handles in the browser, look at its UV map",
        description=__doc__,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("mesh", type=Path, metavar="FILE", help="obj, ply, off, stl or glb")
    parser.add_argument("--port", type=int, default=8080, help="of the page (8080)")
    parser.add_argument("--host", default="127.0.0.1", help="who may look (127.0.0.1: only you)")
    return parser


def run(options: argparse.Namespace) -> int:
    """Serve the page until interrupted."""
    from njf_models.meshfiles import MeshFileError, read_mesh_file  # noqa: PLC0415  (slow import)

    try:
        from njf_models.viewer import Viewer  # noqa: PLC0415  (needs viser)
    except ModuleNotFoundError as error:
        raise CommandError(how_to_install(error)) from error

    try:
        file = read_mesh_file(options.mesh)
        mesh = file.cleaned().mesh
    except MeshFileError as error:
        raise CommandError(f"{options.mesh}: {error}") from error
    with Viewer(mesh, options.mesh.name, options.host, options.port) as viewer:
        print(f"{options.mesh.name} at {viewer.address} (Ctrl-C ends)", flush=True)
        viewer.serve()
    return 0
