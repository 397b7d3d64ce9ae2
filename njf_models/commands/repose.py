"""`njf repose`: a character in another pose."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from njf_models.commands import CommandError, UsageError, how_to_install

if TYPE_CHECKING:
    from torch import Tensor

    import diffpoisson as dp
    from njf_models.repose_network import ReposeNetwork, Stance

_DESCRIPTION = """\
Put a human character into another pose, without skeleton and skinning weights: a network predicts
what the pose does to each triangle. The character stands with half-lowered arms, as in the picture
of docs/bodies.md, x to its left; or, with --any-pose, in whatever pose, upright.
"""

_EPILOG = """\
examples:
  njf repose body.obj sitting.obj --pose sitting.json
  njf repose body.obj nod.obj --joint head 20 0 0 --joint neck01 10 0 0
  njf repose scan.glb some.obj --random 7 --y-up --height 1.75
  njf repose body.obj posed.obj --view
  njf repose dancer.obj sitting.obj --any-pose --pose sitting.json

A pose file is a JSON object: joints and their rotation vectors in degrees, {"head": [20, 0, 0]},
about x, to the left, y, to the back, and z, up; other joints stay. --view serves a page
with a slider for each angle; OUTPUT, which its button writes, may be left out then.
"""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Register the command."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "repose",
        help="put a human character into another pose",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("input", type=Path, metavar="INPUT", help="obj, ply, off, stl or glb file")
    add("output", type=Path, nargs="?", metavar="OUTPUT", help="obj file to write")
    pose = parser.add_mutually_exclusive_group(required=True)
    pose.add_argument("--pose", type=Path, metavar="FILE", help="JSON file of joints")
    pose.add_argument(
        "--joint", nargs=4, action="append", metavar=("NAME", "X", "Y", "Z"), help="turn a joint"
    )
    pose.add_argument("--random", type=int, metavar="SEED", help="a random pose")
    pose.add_argument("--view", action="store_true", help="turn the joints in the browser")
    add("--port", type=int, default=8080, help="of the page of --view (8080)")
    add("--host", default="127.0.0.1", help="who may look (127.0.0.1: only you)")
    add("--any-pose", action="store_true", help="the character stands in another pose than that")
    add("--y-up", action="store_true", help="y is up and z to the front; by default z is up")
    add("--height", type=float, metavar="M", help="of the character, if its unit is not the metre")
    return parser


def run(options: argparse.Namespace) -> int:
    """Write the posed character, or show it."""
    import diffpoisson as dp  # noqa: PLC0415  (slow imports)
    from njf_models.meshfiles import MeshFileError, read_mesh_file  # noqa: PLC0415
    from njf_models.pretrained import load_pretrained  # noqa: PLC0415
    from njf_models.repose_network import Stance  # noqa: PLC0415

    if options.output is None and not options.view:
        raise UsageError("OUTPUT is missing; only --view does without")
    if options.output is not None and options.output.suffix.lower() != ".obj":
        raise UsageError(f"{options.output}: poses are written as .obj")
    if options.height is not None and not options.height > 0:
        raise UsageError("--height must be positive")
    pose = None if options.view else _pose(options)
    try:
        cleaned = read_mesh_file(options.input).cleaned()
    except MeshFileError as error:
        raise CommandError(f"{options.input}: {error}") from error
    x, faces = cleaned.mesh.vertices, cleaned.mesh.faces
    stance = Stance(options.y_up)
    if options.height is not None:
        stance = stance._replace(scale=options.height / stance.height(x))
    network = load_pretrained("repose-any" if options.any_pose else "repose")
    if pose is None:
        return _view(network, dp.Mesh(x, faces), stance, options)
    posed = network.repose(dp.Mesh(stance.standing(x), faces), pose)[0]
    _write(options.output, stance.back(posed), faces)
    print(f"{options.output}  {len(faces):,} triangles")
    return 0


def _view(
    network: ReposeNetwork, mesh: dp.Mesh, stance: Stance, options: argparse.Namespace
) -> int:
    """Serve the page until interrupted."""
    try:
        from njf_models.repose_viewer import ReposeViewer  # noqa: PLC0415  (needs viser)
    except ModuleNotFoundError as error:
        raise CommandError(how_to_install(error)) from error

    def save(vertices: Tensor) -> None:
        _write(options.output, vertices, mesh.faces)
        print(f"{options.output}  {mesh.n_faces:,} triangles", flush=True)

    with ReposeViewer(
        network,
        mesh,
        stance,
        title=options.input.name,
        save=None if options.output is None else save,
        host=options.host,
        port=options.port,
    ) as viewer:
        print(f"{options.input.name} at {viewer.address} (Ctrl-C ends)", flush=True)
        viewer.serve()
    return 0


def _pose(options: argparse.Namespace) -> Tensor:
    """The pose that was asked for: (1, 60), in radians."""
    import numpy as np  # noqa: PLC0415
    import torch  # noqa: PLC0415

    from njf_models.datasets.poses import JOINTS, sample_pose  # noqa: PLC0415

    if options.random is not None:
        vectors = sample_pose(np.random.default_rng(options.random))
        return torch.from_numpy(vectors).reshape(1, -1)
    turns = _turns(options)
    if unknown := sorted(set(turns) - set(JOINTS)):
        raise UsageError(f"no joint {unknown[0]!r}; there are {', '.join(JOINTS)}")
    degrees = torch.zeros(len(JOINTS), 3, dtype=torch.float64)
    for name, vector in turns.items():
        degrees[JOINTS.index(name)] = torch.tensor(vector, dtype=torch.float64)
    return degrees.deg2rad().reshape(1, -1)


def _turns(options: argparse.Namespace) -> dict[str, list[float]]:
    """Rotation vectors of joints, in degrees."""
    try:
        if options.joint:
            return {name: [float(x) for x in vector] for name, *vector in options.joint}
        turns = json.loads(options.pose.read_text(encoding="utf-8"))
        return {name: [float(v) for v in (x, y, z)] for name, (x, y, z) in turns.items()}
    except OSError as error:
        raise CommandError(f"{options.pose}: {error.strerror}") from error
    except (AttributeError, TypeError, ValueError) as error:
        where = options.pose or "--joint"
        raise UsageError(f"{where}: a joint needs three numbers, in degrees ({error})") from error


def _write(path: Path, vertices: Tensor, faces: Tensor) -> None:
    from njf_models.meshfiles import whole_file  # noqa: PLC0415  (slow import)

    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    try:
        with whole_file(path) as unfinished:
            unfinished.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise CommandError(f"{path}: {error.strerror}") from error
