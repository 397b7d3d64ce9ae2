"""The network as a differentiable layer: refine its UV map of one mesh by descending on the code.

The code is what the network knows of a whole shape. A loss on the UV map, here its distortion, goes
back through the Poisson solves and the network to the code, which is optimised for this mesh alone;
the weights stay. Any loss on the map can take its place.

Takes about ten seconds of processor time. Writes to the folder `--out`: refine.png, results.json.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch

import diffpoisson as dp
from njf_models import load_pretrained
from njf_models.losses import distortion_loss
from njf_models.metrics import count_flips
from njf_models.report import UVRow, save_uv_report


def main(argv: list[str] | None = None) -> dict[str, list[float]]:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/refine"))
    parser.add_argument("--size", type=int, default=24, help="vertices along each side (24)")
    parser.add_argument("--steps", type=int, default=60)
    options = parser.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)

    network = load_pretrained("uv")
    disk = network.prepare(wavy_dome(options.size))
    model, shape = network.model.requires_grad_(False), disk.shape
    code = model.encode(disk.points[None])[0].clone().requires_grad_()
    optimiser = torch.optim.Adam([code], lr=0.01)

    losses, flips, first = [], [], None
    for _ in range(options.steps + 1):
        prediction = model(shape, code)
        loss = distortion_loss(shape, prediction)
        losses.append(float(loss.detach()))
        J = dp.jacobians(shape.mesh, prediction.vertices.detach())
        flips.append(int(count_flips(J)))
        first = prediction.vertices.detach() if first is None else first
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

    print(f"distortion {losses[0]:.4f} -> {losses[-1]:.4f}, flips {flips[0]} -> {flips[-1]}")
    maps = {"as predicted": first, "code refined": prediction.vertices.detach()}
    title = f"{shape.mesh.n_faces} faces\ndistortion {losses[0]:.3f} → {losses[-1]:.3f}"
    save_uv_report([UVRow(title, shape.mesh, maps)], None, options.out / "refine.png")
    results = {"distortion": losses, "flips": flips}
    (options.out / "results.json").write_text(json.dumps(results, indent=1))
    return results


def wavy_dome(size: int) -> dp.Mesh:
    """A high dome with waves on it: a disk that has to be stretched, with little left to gain."""
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
