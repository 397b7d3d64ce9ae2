"""Ambient matrices restricted to the faces' tangent planes, π(P) = P B (paper, eq. 6), and back."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from diffpoisson.arguments import require_tensor
from diffpoisson.transforms import without_autocast


def restrict(
    P: Float[Tensor, "*batch m c D"], frames: Float[Tensor, "m D d"]
) -> Float[Tensor, "*batch m c d"]:
    """Restrict each matrix to its face's tangent plane, R = P B: what P does to tangent vectors.

    Args:
        P: (…, m, c, D) one matrix per face, acting on ambient vectors; c output coordinates.
        frames: (m, D, d) orthonormal tangent bases, `Mesh.frames`.

    Raises:
        ValueError: the shapes do not fit.
        TypeError: not tensors of floating dtype.
    """
    _check("restrict", P, frames, "D", 1)
    return _product(P, frames)


def extend(
    R: Float[Tensor, "*batch m c d"], frames: Float[Tensor, "m D d"]
) -> Float[Tensor, "*batch m c D"]:
    """Extend intrinsic matrices to ambient vectors by zero along the normal, R Bᵀ.

    Right inverse of `restrict`: `restrict(extend(R, frames), frames) == R`.

    Args:
        R: (…, m, c, d) one matrix per face, in the frame's coordinates.
        frames: (m, D, d) orthonormal tangent bases, `Mesh.frames`.

    Raises:
        ValueError: the shapes do not fit.
        TypeError: not tensors of floating dtype.
    """
    _check("extend", R, frames, "d", 2)
    return _product(R, frames.mT)


def _product(matrices: Tensor, frames: Tensor) -> Tensor:
    with without_autocast(matrices.device):
        return matrices @ frames.to(matrices.dtype)


def _check(operation: str, matrices: Tensor, frames: Tensor, name: str, axis: int) -> None:
    require_tensor(operation, "frames", frames)
    if frames.ndim != 3:
        raise ValueError(
            f"{operation}: expected frames of shape (m, D, d), got {tuple(frames.shape)}"
        )
    require_tensor(operation, "matrices", matrices, frames.device)
    m, columns = len(frames), frames.shape[axis]
    if matrices.ndim < 3 or matrices.shape[-3] != m or matrices.shape[-1] != columns:
        raise ValueError(
            f"{operation}: with frames of shape {tuple(frames.shape)} expected matrices of shape "
            f"(…, m={m}, c, {name}={columns}), got {tuple(matrices.shape)}"
        )
