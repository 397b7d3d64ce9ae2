"""A surface unrolls into its UV map, each frame a Poisson solve of interpolated Jacobians.

Between the surface and its map, each triangle turns and stretches: F = Q S, a rotation and a
symmetric matrix. At time t it shall have turned by t of the angle and stretched by t of the way,
exp(t log Q) ((1 - t) I + t S); no surface has exactly these Jacobians, and the Poisson solve finds
the closest one. Straight lines from start to end would shrink it on the way.

The surface is a dog's bone from `dm_control` (`--bone`; or `--mesh FILE`), cut and mapped by
`njf_models.parameterize`. Takes about a minute. Writes to the folder `--out`: unroll.gif.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from scipy.sparse import coo_matrix, csgraph
from scipy.spatial.transform import Rotation
from torch import Tensor

import diffpoisson as dp
from njf_models import parameterize
from njf_models.datasets.sources import DogBones, read_mesh
from njf_models.report import render_checkerboard


def main(argv: list[str] | None = None) -> list[Tensor]:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/unroll"))
    parser.add_argument("--bone", default="dog/Scapula_L", help="a dog's (dog/Scapula_L)")
    parser.add_argument("--mesh", type=Path, help="a mesh file instead")
    parser.add_argument("--frames", type=int, default=36, help="on the way there (36)")
    parser.add_argument("--size", type=int, default=360, help="pixels of each side (360)")
    options = parser.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)

    uvmap = parameterize(surface(options), cut=True)
    mesh, solver = uvmap.mesh, dp.PoissonSolver(uvmap.mesh)
    stretches, turns, whole = motion(mesh, dp.jacobians(mesh, uvmap.uv))
    times = (1 - torch.cos(torch.linspace(0, math.pi, options.frames))) / 2  # starts and ends slow
    shapes = [solver(interpolated(mesh, stretches, turns, float(t))) @ whole.T for t in times]

    everything = torch.cat(shapes)
    square = 0.04 * float((everything.amax(0) - everything.amin(0)).norm())
    images = [
        render_checkerboard(dp.Mesh(shape, mesh.faces), uvmap.uv, options.size, square, everything)
        for shape in shapes
    ]
    save(images, options.out / "unroll.gif")
    print(options.out / "unroll.gif")
    return shapes


def surface(options: argparse.Namespace) -> dp.Mesh:
    """The mesh to unroll."""
    if options.mesh:
        return dp.Mesh.cleaned(*read_mesh(options.mesh), merge_duplicates=True).mesh
    bone = next(bone for bone in DogBones(n_faces=1) if bone.name == options.bone)
    return dp.Mesh.cleaned(bone.vertices, bone.faces, merge_duplicates=True).mesh


def motion(
    mesh: dp.Mesh, J: Float[Tensor, "m 2 2"]
) -> tuple[Float[Tensor, "m 3 3"], Float[Tensor, "m 3"], Float[Tensor, "3 3"]]:
    """F = G Q S from each triangle and its normal to its image and the z-axis: S, log Q and G.

    G is what the triangles turn on average; all of the surface may be turned by it from the start.
    """
    n = mesh.n_faces
    image = torch.eye(3, dtype=torch.float64).repeat(n, 1, 1)
    image[:, :2, :2] = J
    F = image @ torch.cat([mesh.frames, mesh.normals[:, :, None]], dim=2).mT
    G = dp.closest_rotation((mesh.areas[:, None, None] * F).sum(0))
    Q = G.mT @ dp.closest_rotation(F)
    turns = Rotation.from_matrix(Q.numpy()).as_rotvec()
    return Q.mT @ G.mT @ F, torch.from_numpy(continuous(mesh, turns)), G


def continuous(mesh: dp.Mesh, turns: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    """Rotation vectors up to full turns: of each triangle the one closest to a neighbour's.

    The neighbour is the one before on shortest paths from the first triangle; all triangles that
    are as many steps away are done at once.
    """
    edge = np.sort(mesh.faces.numpy()[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    order = np.lexsort(edge.T)
    same = (edge[order[1:]] == edge[order[:-1]]).all(1)
    a, b = order[1:][same] // 3, order[:-1][same] // 3
    dual = coo_matrix((np.ones(len(a)), (a, b)), shape=(mesh.n_faces,) * 2)
    steps, before = csgraph.dijkstra(
        dual, directed=False, indices=0, unweighted=True, return_predecessors=True
    )
    turns = turns.copy()
    for step in range(1, int(steps.max()) + 1):
        now = np.flatnonzero(steps == step)
        angle = np.linalg.norm(turns[now], axis=1, keepdims=True)
        axis = turns[now] / np.where(angle > 0, angle, 1)
        wound = np.stack([turns[now] + 2 * np.pi * k * axis for k in (-1, 0, 1)])
        nearest = np.linalg.norm(wound - turns[before[now]], axis=2).argmin(0)
        turns[now] = wound[nearest, np.arange(len(now))]
    return turns


def interpolated(
    mesh: dp.Mesh, stretches: Float[Tensor, "m 3 3"], turns: Float[Tensor, "m 3"], t: float
) -> Float[Tensor, "m 3 2"]:
    """Jacobians at time t: those of the surface at 0, of the map at 1."""
    Q = torch.from_numpy(Rotation.from_rotvec(t * turns.numpy()).as_matrix())
    S = (1 - t) * torch.eye(3, dtype=torch.float64) + t * stretches
    return Q @ S @ mesh.frames


def save(images: list[np.ndarray], path: Path) -> None:
    """A loop there and back, with a rest at either end."""
    frames = [Image.fromarray((255 * image).astype(np.uint8)) for image in images]
    palette = frames[0].quantize(64)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [900, *[45] * (len(frames) - 2), 900]
    frames[0].save(
        path,
        save_all=True,
        append_images=frames[1:] + frames[-2:0:-1],
        duration=durations + durations[-2:0:-1],
        loop=0,
    )


if __name__ == "__main__":
    main()
