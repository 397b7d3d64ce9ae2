"""`python -m diffpoisson`: versions, devices, and whether the layers compute what they should here.

What is checked is what an installation can spoil: the factor, the torch operators around it on each
device, and libigl. Each answer is compared with dense linear algebra that shares no code with the
layers: ∇ by pseudo-inverses of the faces' edges, L⁻¹ by a dense inverse.
"""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable, Iterator
from importlib import metadata
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp

_DISTRIBUTIONS = ("diffpoisson", "torch", "numpy", "scipy", "cholespy", "libigl", "jaxtyping")
# Roundings in float64 times the condition number of the small mesh, with two digits to spare.
_TOLERANCE = 1e-10


class _Case(NamedTuple):
    """A small problem: a bent square in space, and a field of matrices that is no gradient."""

    mesh: dp.Mesh
    R: Float[Tensor, "m 2 3"]
    direction: Float[Tensor, "m 2 3"]

    @classmethod
    def on(cls, device: torch.device, size: int = 7) -> _Case:
        x, y = torch.meshgrid(*2 * [torch.linspace(-1, 1, size).double()], indexing="ij")
        vertices = torch.stack([x, y + 0.2 * x, 0.5 * x**2 - 0.3 * x * y], dim=-1).reshape(-1, 3)
        i = torch.arange(size * size).reshape(size, size)
        a, b, c, d = (t.flatten() for t in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
        faces = torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)])
        generator = torch.Generator().manual_seed(0)
        fields = torch.randn(2, len(faces), 2, 3, dtype=torch.float64, generator=generator)
        return cls(dp.Mesh(vertices.to(device), faces.to(device)), *fields.to(device))


def _dense_map(
    mesh: dp.Mesh, R: Float[Tensor, "m c 3"], vertices: Float[Tensor, "n 3"]
) -> Float[Tensor, "n c"]:
    """argmin Σ |t| ‖(∇Φ - R) on t‖², its area-weighted mean zero, by dense linear algebra."""
    corners = vertices[mesh.faces]
    edges = corners[:, 1:] - corners[:, :1]
    areas = torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1) / 2
    differences = edges.new_tensor([[-1.0, 1, 0], [-1, 0, 1]])
    one_hot = torch.eye(mesh.n_vertices, dtype=edges.dtype, device=edges.device)[mesh.faces]
    gradient = torch.linalg.pinv(edges) @ differences @ one_hot  # (m, 3, n)
    weighted = (areas[:, None, None] * gradient).flatten(0, 1).mT
    L = weighted @ gradient.flatten(0, 1)
    b = weighted @ R.mT.flatten(0, 1)
    free = torch.linalg.inv(L[1:, 1:]) @ b[1:]
    phi = torch.cat([torch.zeros_like(free[:1]), free])
    shares = (areas[:, None] * one_hot.sum(1)).sum(0)
    return phi - (shares @ phi) / shares.sum()


def _loss(phi: Float[Tensor, "n c"]) -> Float[Tensor, ""]:
    """A function of a map with derivatives of every order."""
    return (phi.sin() * phi.flip(0)).sum()


# ------------------------------------------------------- checks: each returns a relative error


def _error(actual: Tensor, expected: Tensor) -> float:
    return float((actual - expected).abs().max() / expected.abs().max())


def _solve(case: _Case) -> float:
    mesh = case.mesh
    return _error(dp.PoissonSolver(mesh)(case.R), _dense_map(mesh, case.R, mesh.vertices))


def _backward(case: _Case) -> float:
    """By the field and by the geometry, with a second solve for each."""
    mesh, solver = case.mesh, dp.PoissonSolver(case.mesh)
    R, v = case.R.clone().requires_grad_(), mesh.vertices.clone().requires_grad_()
    actual = torch.autograd.grad(_loss(solver(R, vertices=v)), (R, v))
    expected = torch.autograd.grad(_loss(_dense_map(mesh, R, v)), (R, v))
    return max(map(_error, actual, expected))


def _transforms(case: _Case) -> float:
    """Forward over reverse mode, batched by vmap."""
    mesh, solver = case.mesh, dp.PoissonSolver(case.mesh)

    def products(layer: Callable[[Tensor], Tensor]) -> Tensor:
        gradient = torch.func.grad(lambda R: _loss(layer(R)))
        directions = torch.stack([case.direction, case.R])
        return torch.func.vmap(lambda v: torch.func.jvp(gradient, (case.R,), (v,))[1])(directions)

    return _error(products(solver), products(lambda R: _dense_map(mesh, R, mesh.vertices)))


def _parameterize(case: _Case) -> float:
    """No error to measure: the certificate is exact."""
    uvmap = dp.parameterize(case.mesh)
    if not uvmap.certified:
        raise ValueError(f"the UV map is not certified, {uvmap.flipped} triangles are flipped")
    return 0.0


_CHECKS = {
    "Poisson solve": _solve,
    "derivatives by field and geometry": _backward,
    "second derivatives, vmap of jvp of grad": _transforms,
    "certified UV map": _parameterize,
}


# ------------------------------------------------------- the report


def _devices() -> Iterator[tuple[torch.device, str]]:
    """Those that the layers run on: of several GPUs, cholespy knows the first alone."""
    yield torch.device("cpu"), f"torch uses {torch.get_num_threads()} thread(s)"
    if torch.cuda.is_available():
        yield torch.device("cuda", 0), torch.cuda.get_device_name(0)


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "not installed"


def main() -> int:
    """Print the report.

    Returns:
        0 if every check passed, else 1.
    """
    print(f"{'python':<12}{platform.python_version()}, {platform.platform()}")
    for name in _DISTRIBUTIONS:
        print(f"{name:<12}{_version(name)}")
    failures = 0
    for device, description in _devices():
        print(f"\n{device}: {description}")
        for name, check in _CHECKS.items():
            complaint = _complaint(check, device)
            print(f"  {name:<42}{f'FAILED: {complaint}' if complaint else 'ok'}")
            failures += complaint is not None
    return 1 if failures else 0


def _complaint(check: Callable[[_Case], float], device: torch.device) -> str | None:
    """What is wrong, if anything."""
    try:
        error = check(_Case.on(device))
    except Exception as exception:  # whatever a broken installation raises is the answer
        return f"{type(exception).__name__}: {exception}"
    if error <= _TOLERANCE:
        return None
    return f"relative error {error:.1e}, more than {_TOLERANCE:.0e}"  # or NaN


if __name__ == "__main__":
    sys.exit(main())
