"""Which solvers survive which torch transform: the table in `docs/transforms.md`.

    python -m tests.benchmarks.transforms_table && python docs/update_tables.py

Every solver gets the same small symmetric positive definite system A x = b and the same nonlinear
scalar of x. Each cell compares with the dense inverse in float64 and says `correct` (to 1e-6),
`WRONG` with the relative error, or `raises` with the exception. Derivatives by the right-hand side
b and by the entries of A are separate columns. Peers are optional: what cannot be imported is
listed as such. Each runs on the CPU in float64, with a direct solver or at a tolerance of 1e-12.
Results, with what was raised, go to `docs/results/transforms.json`.
"""

from __future__ import annotations

import importlib.metadata
import json
import platform
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cholespy
import numpy as np
import scipy.sparse as sp
import torch
from torch import Tensor
from torch.func import grad, hessian, jacfwd, jvp, vmap

from diffpoisson.factor import CholeskyFactor
from diffpoisson.linear_map import CellwiseInverse, LinearMap

Solve = Callable[[Tensor, Tensor], Tensor]  # (entries of A, b) -> A⁻¹ b
TOLERANCE = 1e-6

# ------------------------------------------------------- the problem

N = 6
EDGES = torch.tensor([[i, i + 1] for i in range(N - 1)] + [[0, N - 1], [1, 4]])


def entries() -> Tensor:
    """(7, 2, 2) one matrix for each edge of a graph, whose sum is A."""
    B = torch.randn(len(EDGES), 2, 2, generator=torch.Generator().manual_seed(0)).double()
    return B @ B.mT + torch.eye(2).double()


ROWS = EDGES[:, :, None].expand(-1, 2, 2).flatten()
COLUMNS = EDGES[:, None, :].expand(-1, 2, 2).flatten()


def dense(K: Tensor) -> Tensor:
    P = torch.nn.functional.one_hot(EDGES, N).double()
    return torch.einsum("eki,ekl,elj->ij", P, K, P)


def right_hand_side() -> Tensor:
    return torch.randn(N, 2, generator=torch.Generator().manual_seed(1)).double()


def sparse(K: Tensor) -> sp.csr_matrix:
    values, rows, columns = (x.detach().numpy() for x in (K.flatten(), ROWS, COLUMNS))
    return sp.csr_matrix((values, (rows, columns)), shape=(N, N))


# ------------------------------------------------------- solvers


def ours() -> tuple[Solve, Solve]:
    factor = CholeskyFactor(sparse(entries()))
    fixed, moving = LinearMap(factor), CellwiseInverse(factor, EDGES)
    return lambda K, b: fixed(b), moving


def plain_function() -> tuple[Solve, None]:
    """What one writes first: an autograd.Function around cholespy."""
    coo = sparse(entries()).tocoo()
    arrays = coo.row.astype(np.int32), coo.col.astype(np.int32), coo.data
    solver = cholespy.CholeskySolverD(
        N, *(torch.from_numpy(a) for a in arrays), cholespy.MatrixType.COO
    )

    class Solution(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, b: Tensor) -> Tensor:
            x = torch.empty_like(b)
            solver.solve(b.detach().contiguous(), x)
            return x

        @staticmethod
        def backward(ctx: Any, grad: Tensor) -> Tensor:
            return Solution.apply(grad.contiguous())

    return (lambda K, b: Solution.apply(b)), None


def torch_sla() -> tuple[Solve, Solve]:
    from torch_sla import spsolve

    def solve(K: Tensor, b: Tensor) -> Tensor:
        return spsolve(K.flatten(), ROWS, COLUMNS, (N, N), b, backend="scipy", method="lu")

    return solve, solve


def torchsparsegradutils() -> tuple[Solve, Solve]:
    from torchsparsegradutils import sparse_generic_solve
    from torchsparsegradutils.utils import linear_cg
    from torchsparsegradutils.utils.linear_cg import LinearCGSettings

    settings = LinearCGSettings(cg_tolerance=1e-12, max_cg_iterations=200)

    def matrix(K: Tensor) -> Tensor:
        return torch.sparse_coo_tensor(torch.stack([ROWS, COLUMNS]), K.flatten(), (N, N)).coalesce()

    def solve(A: Tensor, b: Tensor) -> Tensor:
        options = {"settings": settings}
        return sparse_generic_solve(A, b, solve=linear_cg, transpose_solve=linear_cg, **options)

    constant = matrix(entries())
    return lambda K, b: solve(constant, b), lambda K, b: solve(matrix(K), b)


def torch_linalg() -> tuple[Solve, Solve]:
    def solve(K: Tensor, b: Tensor) -> Tensor:
        return torch.linalg.solve(dense(K), b)

    return solve, solve


SOLVERS = {
    "diffpoisson": ours,
    "autograd.Function around cholespy": plain_function,
    "torch-sla": torch_sla,
    "torchsparsegradutils": torchsparsegradutils,
    "torch.linalg.solve (dense)": torch_linalg,
}

# ------------------------------------------------------- transforms of a scalar function


TRANSFORMS: dict[str, Callable[[Callable, Tensor], Tensor]] = {}


def transform(name: str) -> Callable[[Callable], Callable]:
    def register(function: Callable) -> Callable:
        TRANSFORMS[name] = function
        return function

    return register


def repeated_backward(f: Callable, x: Tensor, order: int) -> Tensor:
    x = x.clone().requires_grad_()
    y = f(x)
    for _ in range(order):
        (g,) = torch.autograd.grad(y, x, create_graph=True)
        y = (g**2).sum()
    return g.detach()


for order, word in enumerate(("backward", "double backward", "third backward"), 1):
    TRANSFORMS[word] = lambda f, x, order=order: repeated_backward(f, x, order)

transform("func.grad")(lambda f, x: grad(f)(x))
transform("func.jvp")(lambda f, x: jvp(f, (x,), (x.cos(),))[1])
transform("func.hessian")(lambda f, x: hessian(f)(x))
transform("jacfwd of jacfwd")(lambda f, x: jacfwd(jacfwd(f))(x))
transform("grad of jvp")(lambda f, x: grad(lambda x: jvp(f, (x,), (x.detach().cos(),))[1])(x))


@transform("vmap over tangents")
def _(f: Callable, x: Tensor) -> Tensor:
    return vmap(lambda v: jvp(f, (x,), (v,))[1])(torch.stack([x.cos(), x.sin()]))


@transform("vmap over arguments")
def _(f: Callable, x: Tensor) -> Tensor:
    return vmap(grad(f))(torch.stack([x, 2 * x]))


@transform("batched grads")
def _(f: Callable, x: Tensor) -> Tensor:
    x = x.clone().requires_grad_()
    y = f(x) * torch.arange(1.0, 4).double()
    return torch.autograd.grad(y, x, torch.eye(3).double(), is_grads_batched=True)[0]


def compiled(f: Callable) -> Callable:
    torch.compiler.reset()
    return torch.compile(f, fullgraph=True, backend="aot_eager")


@transform("compiled backward")
def _(f: Callable, x: Tensor) -> Tensor:
    x = x.clone().requires_grad_()
    compiled(f)(x).backward()
    return x.grad


transform("compiled func.grad")(lambda f, x: compiled(grad(f))(x))
transform("compiled jvp")(lambda f, x: compiled(lambda x, v: jvp(f, (x,), (v,))[1])(x, x.cos()))

# ------------------------------------------------------- the table


def by_rhs(solve: Solve) -> tuple[Callable, Tensor]:
    K = entries()
    return lambda b: (solve(K, b + b**2 / 2) ** 3).sum(), right_hand_side()


def by_matrix(solve: Solve) -> tuple[Callable, Tensor]:
    b = right_hand_side()
    return lambda K: (solve(K, b) ** 3).sum(), entries()


def reference(K: Tensor, b: Tensor) -> Tensor:
    # Not torch.linalg.solve, whose own row shows why.
    return torch.linalg.inv(dense(K)) @ b


def eager(name: str) -> Callable:
    """The uncompiled counterpart, for the reference."""
    counterparts = {"backward": "backward", "func.grad": "func.grad", "jvp": "func.jvp"}
    return TRANSFORMS[counterparts.get(name.removeprefix("compiled "), name)]


def outcome(apply: Callable, f: Callable, x: Tensor, expected: Tensor) -> dict[str, Any]:
    try:
        actual = apply(f, x.clone())
    except Exception as error:  # whatever a peer raises is the result
        return {"outcome": "raises", "error": f"{type(error).__name__}: {error}"[:200]}
    error = (actual - expected).abs().max() / expected.abs().max()
    verdict = "correct" if error <= TOLERANCE else "WRONG"
    return {"outcome": verdict, "relative error": float(error)}


def row(solve: Solve, function_of: Callable) -> dict[str, Any]:
    (f, x), (exact, _) = function_of(solve), function_of(reference)
    return {name: outcome(apply, f, x, eager(name)(exact, x)) for name, apply in TRANSFORMS.items()}


def measure() -> dict[str, Any]:
    rows: dict[str, Any] = {}
    for name, build in SOLVERS.items():
        try:
            by_b, by_A = build()
        except ImportError as error:
            rows[name] = {"missing": str(error)}
            continue
        rows[name] = {"by b": row(by_b, by_rhs)}
        if by_A is not None:
            rows[name]["by A"] = row(by_A, by_matrix)
    return {"versions": versions(), "transforms": list(TRANSFORMS), "rows": rows}


def versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in ("torch", "cholespy", "torch-sla", "torchsparsegradutils"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def main() -> None:
    warnings.simplefilter("ignore")
    path = Path(__file__).parents[2] / "docs" / "results" / "transforms.json"
    path.write_text(json.dumps(measure(), indent=1) + "\n")


if __name__ == "__main__":
    main()
