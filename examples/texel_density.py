"""The network as a differentiable layer: more texels where one wants them.

An artist's wish as a loss: the top of a dome shall get twice the texels per area of the rest. It
goes back through the Jacobians of the map, the Poisson solves and the network to the code, which is
what the network knows of the whole shape; the code is optimised for this mesh alone, the weights
stay. The distortion loss beside it keeps the map from folding. Any loss on the map can take their
place.

Takes about fifteen seconds of processor time. Writes to the folder `--out`: density.png,
results.json.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

import diffpoisson as dp
from njf_models import load_pretrained
from njf_models.losses import distortion_loss
from njf_models.metrics import count_flips
from njf_models.report import UVRow, save_uv_report


def main(argv: list[str] | None = None) -> dict[str, list[float]]:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/density"))
    parser.add_argument("--size", type=int, default=24, help="vertices along each side (24)")
    parser.add_argument("--ratio", type=float, default=2.0, help="of the densities (2)")
    parser.add_argument("--steps", type=int, default=80)
    options = parser.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)

    network = load_pretrained("uv-pointnet")  # which has a code to descend on
    disk = network.prepare(wavy_dome(options.size))
    model, shape = network.model.requires_grad_(False), disk.shape
    top = highest(shape.mesh, share=0.25)
    code = model.encode(disk.points[None])[0].clone().requires_grad_()
    optimiser = torch.optim.Adam([code], lr=0.03)

    history: dict[str, list[float]] = {"ratio": [], "distortion": [], "flips": []}
    maps = []
    for _ in range(options.steps + 1):
        prediction = model(shape, code)
        J = dp.jacobians(shape.mesh, prediction.vertices)
        ratio = density(shape.mesh, J, top) / density(shape.mesh, J, ~top)
        distortion = distortion_loss(shape, prediction)
        loss = (ratio.log() - math.log(options.ratio)).square() + 0.3 * distortion
        for name, value in (("ratio", ratio), ("distortion", distortion)):
            history[name].append(float(value.detach()))
        history["flips"].append(int(count_flips(J.detach())))
        maps.append(prediction.vertices.detach())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

    before, after = ({name: values[at] for name, values in history.items()} for at in (0, -1))
    for name in history:
        print(f"{name}: {before[name]:.3g} -> {after[name]:.3g}")
    title = (
        f"{shape.mesh.n_faces} faces\ntexels on top: {before['ratio']:.2f} → {after['ratio']:.2f}"
    )
    rows = [UVRow(title, shape.mesh, {"as predicted": maps[0], "denser on top": maps[-1]})]
    save_uv_report(rows, None, options.out / "density.png")
    (options.out / "results.json").write_text(json.dumps(history, indent=1))
    return history


def density(mesh: dp.Mesh, J: Float[Tensor, "m 2 2"], part: Bool[Tensor, "m"]) -> Float[Tensor, ""]:
    """Area in the texture over area on the surface."""
    areas = mesh.areas[part].to(J.dtype)
    return (torch.linalg.det(J[part]) * areas).sum() / areas.sum()


def highest(mesh: dp.Mesh, share: float) -> Bool[Tensor, "m"]:
    """The share of the faces that lies highest."""
    heights = mesh.vertices[mesh.faces, 2].mean(dim=1)
    return heights >= heights.quantile(1 - share)


def wavy_dome(size: int) -> dp.Mesh:
    """A high dome with waves on it: a disk that has to be stretched."""
    x, y = torch.meshgrid(
        torch.linspace(-1, 1, size, dtype=torch.float64),
        torch.linspace(-1, 1, size, dtype=torch.float64),
        indexing="ij",
    )
    z = 1.5 * torch.exp(-1.5 * (x**2 + y**2)) + 0.15 * torch.sin(5 * x) * torch.cos(4 * y)
    i = torch.arange(size * size).reshape(size, size)
    a, b, c, d = (t.flatten() for t in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    faces = torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)])
    return dp.Mesh(torch.stack([x, y, z], dim=-1).reshape(-1, 3), faces)


if __name__ == "__main__":
    main()
