"""`njf info`: facts about mesh files, or about a set of trained weights."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from njf_models.commands import CommandError

_DESCRIPTION = """\
Facts about mesh files: counts, components, topology, boundaries, area, thinnest face.
The name of trained weights instead of a file shows their card.
"""

_EPILOG = """\
examples:
  njf info bunny.obj
  njf info --json - scans/*.ply
  njf info uv
"""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Register the command."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "info",
        help="facts about mesh files or trained weights",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="+", metavar="FILE", help="mesh file, or name of weights")
    parser.add_argument("--json", metavar="FILE", help="write the facts as JSON; - for stdout")
    return parser


def run(options: argparse.Namespace) -> int:
    """Print facts about each name; 1 if any of them could not be read."""
    facts: dict[str, dict[str, Any]] = {}
    failed = False
    for name in options.names:
        try:
            facts[name] = _facts(name)
        except CommandError as error:
            failed = True
            print(f"njf info: {name}: {error}", file=sys.stderr)
    if options.json == "-":
        print(json.dumps(facts, indent=1, allow_nan=False))
        return int(failed)
    if options.json:
        _write(Path(options.json), json.dumps(facts, indent=1, allow_nan=False) + "\n")
    print("\n\n".join(_text(name, values) for name, values in facts.items()))
    return int(failed)


def _write(path: Path, text: str) -> None:
    from njf_models.meshfiles import whole_file  # noqa: PLC0415  (slow import)

    try:
        with whole_file(path) as unfinished:
            unfinished.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CommandError(f"{path}: {error.strerror}") from error


def _facts(name: str) -> dict[str, Any]:
    from njf_models.meshfiles import MeshFileError, read_mesh_file  # noqa: PLC0415  (slow import)

    path = Path(name)
    if not path.suffix and not path.exists():
        return _card(name)
    try:
        file = read_mesh_file(path)
        return mesh_facts(file)
    except MeshFileError as error:
        raise CommandError(str(error)) from error


def _card(name: str) -> dict[str, Any]:
    """What is known of trained weights."""
    from njf_models import pretrained  # noqa: PLC0415  (imports torch)

    card = getattr(pretrained, "card", None)
    if card is None:
        raise CommandError("no such file")
    try:
        return dict(card(name))
    except (KeyError, ValueError, OSError) as error:
        raise CommandError(f"no such file, nor weights of that name ({error})") from error


def mesh_facts(file: Any) -> dict[str, Any]:
    """Facts about a `MeshFile`, plain numbers and words."""
    cleaned = file.cleaned()
    mesh = cleaned.mesh
    thinnest, angle = _thinnest(mesh)
    low, high = mesh.vertices.amin(0), mesh.vertices.amax(0)
    return {
        "vertices in the file": len(file.vertices),
        "triangles in the file": len(file.faces),
        "polygons": None if file.obj is None else len(file.obj.sizes),
        "vertices at distinct positions": mesh.n_vertices,
        "triangles with an area": mesh.n_faces,
        "pictures": 0 if file.paint is None else sum(i.size > 4 for i in file.paint.images),
        "components": mesh.n_components,
        "topology": _topology(mesh),
        "boundary loops": len(mesh.boundary_loops) if mesh.is_manifold else None,
        "size": (high - low).tolist(),
        "area": float(mesh.areas.sum()),
        "smallest angle, degrees": angle,
        "face with the smallest angle": int((cleaned.face_map == thinnest).nonzero()[0, 0]),
    }


def _topology(mesh: Any) -> str:
    """In the words of an artist: what `njf uv` will have to cut."""
    if not mesh.is_manifold:
        return "not a manifold: edges of more than two faces, or inconsistent orientation"
    holes, chi, n = len(mesh.boundary_loops), mesh.euler_characteristic, mesh.n_components
    if mesh.is_disk:
        return "a disk"
    if n > 1:
        return f"{n} components, {holes} boundary loops, Euler characteristic {chi}"
    genus = (2 - holes - chi) // 2
    kind = "closed surface" if holes == 0 else f"surface with {holes} boundary loops"
    return f"{kind} of genus {genus}"


def _thinnest(mesh: Any) -> tuple[int, float]:
    """The face with the smallest angle, and the angle in degrees."""
    corners = mesh.vertices[mesh.faces]
    sides = corners.roll(-1, 1) - corners
    backward = -sides.roll(1, 1)
    sine = sides.cross(backward, dim=-1).norm(dim=-1)
    angle = sine.atan2((sides * backward).sum(-1)).amin(1)
    face = int(angle.argmin())
    return face, float(angle[face].rad2deg())


def _text(name: str, facts: dict[str, Any]) -> str:
    width = max(map(len, facts))
    rows = [
        f"  {key:<{width}}  {_value(value)}" for key, value in facts.items() if value is not None
    ]
    return "\n".join([name, *rows])


def _value(value: Any) -> str:
    if isinstance(value, bool | str):
        return str(value)
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return " × ".join(map(_value, value))
    return json.dumps(value)
