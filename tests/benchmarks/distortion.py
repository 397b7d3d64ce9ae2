"""Distortion energies by closed forms, against singular values from `torch.linalg`."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

import diffpoisson as dp
from tests.benchmarks import limits
from tests.benchmarks.harness import Figure, Limit, alternate, main, speed_up

Energy = Callable[[Tensor], Tensor]


def by_svd(energy: Energy) -> Energy:
    """An energy of singular values (…, 2), of Jacobians by way of LAPACK."""
    return lambda J: energy(torch.linalg.svdvals(J))


# Ours, and the same as a function of σ₁, σ₂ where det J > 0.
ENERGIES: dict[str, tuple[Energy, Energy]] = {
    "symmetric Dirichlet": (
        dp.symmetric_dirichlet,
        by_svd(lambda s: (s.square() + s.square().reciprocal()).sum(-1)),
    ),
    "ARAP": (dp.arap, by_svd(lambda s: (s - 1).square().sum(-1))),
    "MIPS": (dp.mips, by_svd(lambda s: s[..., 0] / s[..., 1] + s[..., 1] / s[..., 0])),
}


def energies(quick: bool) -> Iterator[Figure]:
    """Each energy and its gradient at a million random Jacobians without flips, in float32."""
    m = 1000 if quick else 1_000_000
    generator = torch.Generator().manual_seed(0)
    J = torch.eye(2) + 0.2 * torch.randn(m, 2, 2, generator=generator)
    J = torch.where(dp.flipped(J)[:, None, None], torch.eye(2), J).requires_grad_()

    def gradient(energy: Energy) -> Tensor:
        return torch.autograd.grad(energy(J).sum(), J)[0]

    # Read J, write the energy; read J and the derivative of the energy, write the gradient.
    traffic = 3 * J.nbytes + 2 * 4 * m
    limit = Limit(f"{traffic / 1e6:.0f} MB moved", traffic / limits.bandwidth(traffic))
    for name, (ours, theirs) in ENERGIES.items():
        torch.testing.assert_close(gradient(ours), gradient(theirs), rtol=0.02, atol=0.02)
        contestants = {
            "ours": lambda ours=ours: gradient(ours),
            "torch.linalg.svdvals": lambda theirs=theirs: gradient(theirs),
        }
        seconds = alternate(contestants, turns=7)
        what = f"{name}, forward + backward, {m:,} faces, float32"
        yield speed_up(what, seconds, "torch.linalg.svdvals", 20.0, limit=limit)


MEASUREMENTS = {"energies": energies}

if __name__ == "__main__":
    main("distortion", MEASUREMENTS)
