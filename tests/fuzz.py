"""Malformed arguments to every public function: an error that says so, or a right answer.

    python -m tests.fuzz --n 100000 --seed 0 --json docs/results/fuzz.json

Case i of a seed is always the same: a valid call is drawn, on an awkward mesh, and up to two of its
arguments are spoilt. The call must raise MeshError, ValueError or TypeError with a message that
names the operation, or return what an independent check accepts. Anything else is a finding:
another exception, a warning, a NaN from finite numbers, a wrong answer, a crash or a hang. Workers
are processes, so that the last two are survived and put down to their case. Interrupted, or after
a repair, the same command tries its findings again and goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing as mp
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

import diffpoisson as dp
from diffpoisson.gradient import gradient_operator
from tests import meshes

Rng = np.random.Generator
Arguments = dict[str, Any]
REFUSALS = (dp.MeshError, ValueError, TypeError)


# ------------------------------------------------------- how arguments are spoilt


def _with_value(x: Tensor, rng: Rng, value: float) -> Tensor:
    x = x.clone()
    if x.numel():
        x.view(-1)[rng.integers(x.numel())] = value
    return x


def _strided(x: Tensor) -> Tensor:
    """The same values, in every other place of the memory."""
    wide = torch.stack([x, torch.full_like(x, torch.nan)], dim=-1)
    return wide[..., 0]


def _read_only(x: Tensor) -> np.ndarray:
    array = x.numpy().copy()
    array.flags.writeable = False
    return array


ANY: dict[str, Callable[[Tensor, Rng], Any]] = {
    "none": lambda x, rng: None,
    "string": lambda x, rng: "vertices",
    "number": lambda x, rng: 3.0,
    "object": lambda x, rng: object(),
    "list": lambda x, rng: x.tolist(),
    "ragged list": lambda x, rng: [[1.0], [1.0, 2.0]],
    "numpy": lambda x, rng: x.numpy(),
    "read-only numpy": lambda x, rng: _read_only(x),
    "reversed numpy": lambda x, rng: x.numpy()[::-1],
    "object array": lambda x, rng: x.numpy().astype(object),
    "strings array": lambda x, rng: x.numpy().astype(str),
    "long double": lambda x, rng: x.numpy().astype(np.longdouble),
    "complex": lambda x, rng: x.to(torch.complex128),
    "bool": lambda x, rng: x.bool(),
    "half": lambda x, rng: x.half(),
    "bfloat16": lambda x, rng: x.bfloat16(),
    "meta": lambda x, rng: x.to("meta"),
    "sparse": lambda x, rng: x.to_sparse(),
    "no rows": lambda x, rng: x[:0],
    "row missing": lambda x, rng: x[:-1],
    "row twice": lambda x, rng: torch.cat([x, x[-1:]]),
    "last dimension empty": lambda x, rng: x[..., :0],
    "last dimension shorter": lambda x, rng: x[..., :-1],
    "last dimension longer": lambda x, rng: torch.cat([x, x[..., -1:]], dim=-1),
    "transposed": lambda x, rng: x.movedim(0, -1),
    "flat": lambda x, rng: x.flatten(),
    "one more dimension": lambda x, rng: x[None],
    "zero-dimensional": lambda x, rng: x.sum(),
    "many columns": lambda x, rng: x[..., None, :].expand(*x.shape[:-1], 500, x.shape[-1]),
    "expanded": lambda x, rng: x[:1].expand(x.shape),
    "reversed": lambda x, rng: x.flip(0),
    "permuted storage": lambda x, rng: x.movedim(0, -1).contiguous().movedim(-1, 0),
}
FLOAT = ANY | {
    "strided": lambda x, rng: _strided(x),
    "integer": lambda x, rng: x.long(),
    "single": lambda x, rng: x.float(),
    "NaN": lambda x, rng: _with_value(x, rng, torch.nan),
    "infinity": lambda x, rng: _with_value(x, rng, torch.inf),
    "huge value": lambda x, rng: _with_value(x, rng, 1e300),
    "scaled": lambda x, rng: x * 10.0 ** rng.uniform(-200, 200),
    "huge": lambda x, rng: x * torch.finfo(x.dtype).max,
    "subnormal": lambda x, rng: x * torch.finfo(x.dtype).tiny,
    "zero": lambda x, rng: torch.zeros_like(x),
    "collinear": lambda x, rng: x * (torch.arange(x.shape[-1]) == 0),
    "requires grad": lambda x, rng: x.clone().requires_grad_(),
    "negative": lambda x, rng: -x,
}
INTEGER = ANY | {
    "negative": lambda x, rng: _with_value(x, rng, -1),
    "very negative": lambda x, rng: _with_value(x, rng, -(2**63)),
    "outside": lambda x, rng: _with_value(x, rng, 10**4),
    "beyond 32 bits": lambda x, rng: _with_value(x, rng, 2**31),
    "beyond 62 bits": lambda x, rng: _with_value(x, rng, 2**62),
    "repeated": lambda x, rng: x[..., :1].expand(x.shape),
    "float": lambda x, rng: x.double(),
    "int32": lambda x, rng: x.int(),
    "uint8": lambda x, rng: x.byte(),
    "uint64": lambda x, rng: x.numpy().astype(np.uint64),
    "big-endian": lambda x, rng: x.numpy().astype(">i8"),
    "zero": lambda x, rng: torch.zeros_like(x),
}
SCALARS: tuple[Any, ...] = (
    *(None, "mean", "voronoi", "", object(), True, 1 + 2j, [1], torch.zeros(2)),
    *(0, -1, 1, 3, 7, 4000, 0.5, -0.5, 1e-300, 1e300, float("nan"), float("inf"), -float("inf")),
)
OTHERS: tuple[Any, ...] = (None, "mesh", 3, object(), np.eye(3), torch.eye(3), [], [None])


def spoil(value: Any, rng: Rng) -> tuple[str, Any]:
    """A malformed (or merely unusual) version of an argument, and what was done to it."""
    if not isinstance(value, Tensor):
        others = SCALARS if isinstance(value, (int, float, str)) else OTHERS
        spoilt = others[rng.integers(len(others))]
        return repr(spoilt)[:30], spoilt
    faults = FLOAT if value.is_floating_point() else INTEGER
    name = rng.choice(sorted(faults))
    try:
        return name, faults[name](value, rng)
    except (RuntimeError, IndexError, ValueError, TypeError, Warning):  # spoilt already
        return "unspoilt", value


# ------------------------------------------------------- what is drawn


def arrays(rng: Rng) -> tuple[Tensor, Tensor]:
    """A small mesh of any topology, at any place and scale, rarely beyond what floats can hold."""
    builders = [*meshes.TOPOLOGIES.values(), tetrahedra]
    vertices, faces = builders[rng.integers(len(builders))](int(rng.integers(1000)))
    if rng.random() < 0.3:
        vertices = vertices * 10.0 ** np.r_[-rng.uniform(0, 9), np.zeros(vertices.shape[1] - 1)]
    vertices = (vertices + rng.normal(size=vertices.shape[1])) * 10.0 ** rng.uniform(-6, 6)
    if rng.random() < 0.05:
        vertices = vertices * 10.0 ** rng.uniform(-150, 150)
    dtype = torch.float32 if rng.random() < 0.2 else torch.float64
    return torch.from_numpy(vertices).to(dtype), torch.from_numpy(faces)


def tetrahedra(seed: int) -> meshes.Arrays:
    """A fan of tetrahedra around an edge."""
    vertices = np.array([[0, 0, -1], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1.0, 0]])
    jitter = 0.2 * np.random.default_rng(seed).uniform(-1, 1, vertices.shape)
    return vertices + jitter, np.array([[0, 1, 2, 3], [0, 1, 3, 4], [0, 1, 4, 5]])


def mesh(rng: Rng) -> dp.Mesh:
    return dp.Mesh(*arrays(rng))


def field(rng: Rng, m: dp.Mesh, *shape: int) -> Tensor:
    dtype = m.dtype if rng.random() < 0.9 else torch.float64
    batch = [(), (2,), (0,), (3, 1)][rng.choice(4, p=[0.7, 0.1, 0.1, 0.1])]
    return torch.from_numpy(rng.normal(size=(*batch, *shape))).to(dtype)


def matrices(rng: Rng, m: dp.Mesh) -> Tensor:
    return field(rng, m, m.n_faces, int(rng.integers(0, 4)), int(rng.choice([m.cell_dim, m.dim])))


def some_vertices(rng: Rng, m: dp.Mesh) -> Tensor:
    return torch.from_numpy(rng.permutation(m.n_vertices)[: rng.integers(1, 3)])


# ------------------------------------------------------- what an answer must satisfy


class WrongAnswerError(AssertionError):
    pass


def require(condition: Any, what: str) -> None:
    if not bool(condition):
        raise WrongAnswerError(what)


def sound(*fields: Any) -> bool:
    """Whether values are finite and neither they nor their squares leave the range."""
    tensors = [x for x in fields if isinstance(x, Tensor) and x.is_floating_point()]
    if any(x.is_meta for x in tensors):
        return False
    bounds = [torch.finfo(x.dtype).max ** 0.25 for x in tensors]
    return all(bool((x.abs() < b).all()) for x, b in zip(tensors, bounds, strict=True))


def reasonable(epsilon: float) -> bool:
    return epsilon == 0 or 1e-6 <= epsilon <= 1e6


def unit(dtype: torch.dtype) -> float:
    return torch.finfo(dtype).eps


def check_mesh(_: Arguments, m: dp.Mesh) -> None:
    require((m.measures > 0).all() and m.measures.isfinite().all(), "measures")
    identity = m._double_frames.mT @ m._double_frames - torch.eye(m.cell_dim)
    require(identity.abs().max() < 1e-12, "frames")
    total = m._double_measures.sum()
    require((m._double_vertex_measures.sum() - total).abs() < 1e-12 * total, "vertex measures")
    require(m.components.shape == (m.n_vertices,), "components")
    require(len(m.split_faces(m.measures)) == m.n_parts, "parts")


def check_jacobians(a: Arguments, J: Tensor) -> None:
    """J e = Φ(v₁) - Φ(v₀) along the first edge of each face."""
    m, phi = a["mesh"], a["phi"]
    width = m.dim if a["extrinsic"] else m.cell_dim
    require(J.shape == (*phi.shape[:-2], m.n_faces, phi.shape[-1], width), "shape")
    require(J.dtype == phi.dtype, "dtype")
    if not sound(phi, a.get("vertices"), m.vertices.to(phi.dtype)) or phi.numel() == 0:
        return
    at = dp.Mesh(a["vertices"].double(), m.faces) if a.get("vertices") is not None else m
    start, end = (at.vertices.double()[m.faces[:, i]] for i in (0, 1))
    edges = (end - start)[:, None, :]
    edges = edges if a["extrinsic"] else edges @ at._double_frames
    J, phi = J.double(), phi.double()
    error = (J * edges).sum(-1) - (phi[..., m.faces[:, 1], :] - phi[..., m.faces[:, 0], :])
    largest = phi.abs().max() + (J.abs() * edges.abs()).max()
    u = unit(a["phi"].dtype)
    # A face may be thinner than roundings of the frame; those grow with the largest gradient.
    gradient = float(np.abs(gradient_operator(at).matrix.data).max())
    if gradient > torch.finfo(a["phi"].dtype).max ** 0.5:  # J may leave the range
        return
    bound = 100 * u * (largest + gradient * phi.abs().max() * edges.abs().max())
    bound += 100 * torch.finfo(a["phi"].dtype).tiny * (1 + edges.abs().max() * gradient)
    require((error.abs() <= bound).all(), f"J e off by {error.abs().max():.1e}")


def check_divergence(a: Arguments, b: Tensor) -> None:
    """Sums to zero over the mesh, and pairs with the coordinates to Σ |t| tr R."""
    m, R = a["mesh"], a["R"]
    require(b.shape == (*R.shape[:-3], m.n_vertices, R.shape[-2]), "shape")
    require(b.dtype == R.dtype, "dtype")
    if not sound(R, m.measures, a.get("vertices")) or R.numel() == 0:
        return
    bound = 1e3 * (unit(R.dtype) * b.abs().double().sum(-2) + torch.finfo(R.dtype).tiny)
    require((b.double().sum(-2).abs() <= bound).all(), "sum")


def check_solution(a: Arguments, phi: Tensor) -> None:
    """The normal equations, up to a backward error."""
    solver, R = a["solver"], a["R"]
    m = solver.mesh
    batch = R.shape[:-3]
    require(phi.shape == (*batch, m.n_vertices, R.shape[-2]), "shape")
    require(phi.dtype == R.dtype, "dtype")
    images = (a.get("pins"), a.get("handles"), a.get("translations"))
    thin = solver.constraints.face_weights.reciprocal()
    images = [x.to(R.dtype) for x in images if x is not None]
    if not sound(R, *images, m.vertices.to(R.dtype), thin) or R.dtype not in (
        torch.float32,
        torch.float64,
    ):
        clean_columns(a, phi)
        return
    require(phi.isfinite().all(), "finite")
    if phi.numel() == 0 or a.get("handles") is not None:
        return
    operator = gradient_operator(m)
    D, G = operator.divergence_matrix, operator.matrix
    D = D.multiply(np.tile(solver.constraints.face_weights.numpy(), m.cell_dim)).tocsr()
    intrinsic = R.double() if R.shape[-1] == m.cell_dim else R.double() @ m._double_frames
    rows = intrinsic.movedim((-1, -3), (0, 1)).reshape(m.n_faces * m.cell_dim, -1).numpy()
    x = phi.double().movedim(-2, 0).reshape(m.n_vertices, -1).numpy()
    L = D @ G
    residual = np.abs(D @ rows - L @ x)
    size = np.abs(D) @ (np.abs(rows) + np.abs(G) @ np.abs(x))
    free = np.ones(m.n_vertices, bool)
    free[solver.constraints.pins.numpy()] = False
    bound = (1e5 * unit(torch.float64) + 10 * unit(R.dtype)) * size.max(0)
    bound += np.abs(L).max() * torch.finfo(R.dtype).tiny
    require((residual[free] <= bound).all(), "normal equations")
    if a.get("pins") is not None:
        at_pins = phi[..., solver.constraints.pins, :]
        require((at_pins == a["pins"].to(R.dtype)).all(), "pins")


def clean_columns(a: Arguments, phi: Tensor) -> None:
    """A NaN stays in its element of the batch and its column."""
    given = [a["R"].isfinite().all(-1).all(-2)]
    images = [x for x in (a.get("pins"), a.get("handles"), a.get("translations")) if x is not None]
    images = [x.to(phi.dtype) for x in images]
    given += [x.isfinite().all(-2).expand(given[0].shape) for x in images]
    if not sound(*(torch.nan_to_num(x, 0, 0, 0) for x in (a["R"], *images))):
        return
    if not sound(a["solver"].mesh.vertices.to(phi.dtype)) or phi.dtype not in (
        torch.float32,
        torch.float64,
    ):
        return
    clean = torch.stack(given).all(0)
    require(phi.isfinite().all(-2)[clean].all(), "a NaN spread to other columns")


def check_density(a: Arguments, value: Tensor) -> None:
    J = a["J"]
    require(value.shape[: J.ndim - 2] == J.shape[:-2], "shape")
    if (
        sound(J)
        and reasonable(a.get("epsilon", 0))
        and (J.square().sum((-2, -1)) > torch.finfo(J.dtype).tiny ** 0.25).all()
    ):
        require(not value.isnan().any(), "NaN")


def check_eigenpairs(a: Arguments, pairs: tuple[Tensor, Tensor]) -> None:
    values, vectors = pairs
    m = a["mesh"]
    require(values.shape == (a["n_eigenpairs"],), "shape")
    require(vectors.shape == (m.n_vertices, a["n_eigenpairs"]), "shape")
    require(values.isfinite().all() and vectors.isfinite().all(), "finite")
    require((values.diff() >= -1e-6 * values.abs().max()).all(), "ascending")
    require((values[: m.n_components] == 0).all(), "kernel")


def check_signature(a: Arguments, value: Tensor) -> None:
    require(len(value) == a["mesh"].n_vertices and value.ndim == 2, "shape")
    require(value.isfinite().all() and (value >= 0).all(), "finite, not negative")


def check_samples(a: Arguments, samples: dp.SurfaceSamples) -> None:
    require(samples.barycentric.shape == (a["n_samples"], 3), "shape")
    require(((samples.barycentric.sum(1) - 1).abs() < 1e-6).all(), "sum")


def check_uv(a: Arguments, uv: Tensor) -> None:
    require(uv.shape == (a["mesh"].n_vertices, 2), "shape")
    require(not dp.flipped(dp.jacobians(a["mesh"], uv)).any(), "flips")


def check_parameterized(a: Arguments, uvmap: dp.UVMap) -> None:
    check_uv(a, uvmap.uv)
    require(uvmap.uv.isfinite().all(), "finite")


def check_certificate(a: Arguments, certificate: dp.Certificate) -> None:
    """Flips are counted as exact fractions say."""
    corners = a["uv"].double()[a["mesh"].faces].numpy()
    if not np.isfinite(corners).all():
        return
    areas = [_exact_area(triangle) for triangle in corners]
    require(certificate.n_flipped == sum(area <= 0 for area in areas), "flips")


def _exact_area(triangle: np.ndarray) -> Fraction:
    (ax, ay), (bx, by), (cx, cy) = [[Fraction(x) for x in corner] for corner in triangle.tolist()]
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)


def check_repaired(a: Arguments, result: tuple[Tensor, int]) -> None:
    """A map of the same shape and dtype, finite; the same where nothing flips."""
    uv, rounds = result
    m = a["mesh"] if "mesh" in a else a["solver"].mesh
    require(uv.shape == a["uv"].shape, "shape")
    require(uv.dtype == a["uv"].dtype, "dtype")
    if not sound(a["uv"]):
        return
    require(uv.isfinite().all(), "finite")
    if rounds == 0:
        require(torch.equal(uv, a["uv"]), "untouched")
    elif not dp.flipped(dp.jacobians(m, a["uv"])).any():
        require(False, "rounds without a flip")


def check_clamped(a: Arguments, J: Tensor) -> None:
    """Singular values within the limits."""
    require(J.shape == a["J"].shape, "shape")
    if J.numel() == 0 or not sound(a["J"], a["J"].reciprocal()):
        return
    values = torch.linalg.svdvals(J.double())
    tolerance = 100 * unit(J.dtype) * a["largest"]
    require((values >= a["smallest"] - tolerance).all(), "smallest")
    require((values <= a["largest"] + tolerance).all(), "largest")
    require((torch.linalg.det(J.double()) > -tolerance * a["largest"]).all(), "flips")


def check_procrustes(a: Arguments, moved: Tensor) -> None:
    require(moved.shape[-2:] == a["source"].shape[-2:], "shape")
    if sound(a["source"], a["target"]) and (a["weights"] > 0).all():
        require(moved.isfinite().all(), "finite")


def check_same_shape(name: str, a: Arguments, value: Tensor) -> None:
    require(value.shape[:-1] == a[name].shape[:-1], "shape")
    if sound(*a.values()):
        require(value.isfinite().all(), "finite")


def check_laplacian_solution(a: Arguments, x: Tensor) -> None:
    """L x = b where rows were solved; rounded to the dtype of b, which may not hold it."""
    solver, b = a["solver"], a["b"]
    require(x.shape == b.shape and x.dtype == b.dtype, "shape or dtype")
    exact = solver.solve_laplacian(b.double())
    require(torch.equal(x.nan_to_num(), exact.to(b.dtype).nan_to_num()), "rounded once")
    if not sound(b) or not b.numel():
        return
    L, free = dp.laplacian(solver.mesh), solver.constraints.free.numpy()
    wide, rhs = exact.numpy(), b.double().numpy()
    residual = np.abs(L @ wide - rhs)[free]
    size = np.abs(L) @ np.abs(wide) + np.abs(rhs)
    require((residual <= 1e5 * unit(torch.float64) * size.max(0)).all(), "L x = b")


def check_laplacian(a: Arguments, L: Any) -> None:
    require(np.isfinite(L.data).all(), "finite")
    require(abs(L - L.T).max() <= 1e-12 * abs(L).max(), "symmetric")
    require(np.abs(L.sum(1)).max() <= 1e-10 * abs(L).max(), "constants in the kernel")


def check_mass(a: Arguments, mass: Tensor) -> None:
    m = a["mesh"]
    require((mass > 0).all(), "positive")
    require((mass.double().sum() / m._double_measures.sum() - 1).abs() < 1e-4, "sum")


def check_parts(a: Arguments, parts: tuple[Tensor, ...]) -> None:
    joined, values = torch.cat(parts, dim=a["dim"]), a["values"]
    if not values.is_meta:
        require(torch.allclose(joined, values, rtol=0, atol=0, equal_nan=True), "parts")


# ------------------------------------------------------- the operations


@dataclass(frozen=True)
class Operation:
    """How to draw arguments, what to call with them, and how to judge what it returns."""

    draw: Callable[[Rng], Arguments]
    call: Callable[..., Any]
    check: Callable[[Arguments, Any], None]
    weight: float = 1.0


def _draw_solver(rng: Rng) -> Arguments:
    m = mesh(rng)
    options: Arguments = {"mesh": m, "gauge": "mean"}
    if rng.random() < 0.4:
        options["pins"] = some_vertices(rng, m)
    if rng.random() < 0.4:
        options["handles"] = some_vertices(rng, m)
        options["handle_weights"] = 10.0 ** rng.uniform(-3, 3)
    if rng.random() < 0.4:
        options["face_weights"] = torch.from_numpy(rng.uniform(0.1, 2, m.n_faces))
    if rng.random() < 0.2:
        options["gauge"] = torch.ones(m.n_vertices, dtype=torch.bool)
    return options


def _make_solver(**options: Any) -> dp.PoissonSolver:
    return dp.PoissonSolver(options.pop("mesh"), **options)


def _check_solver(_: Arguments, solver: dp.PoissonSolver) -> None:
    """It solves."""
    m, constraints = solver.mesh, solver.constraints
    R = torch.ones(m.n_faces, 1, m.cell_dim, dtype=torch.float64)
    images = {
        name: torch.zeros(len(getattr(constraints, name)), 1, dtype=torch.float64)
        for name in ("pins", "handles")
        if len(getattr(constraints, name))
    }
    check_solution({"solver": solver, "R": R, **images}, solver(R, **images))


def _draw_solve(rng: Rng) -> Arguments:
    m = mesh(rng)
    R = matrices(rng, m)
    c, batch = R.shape[-2], R.shape[:-3]
    pins = some_vertices(rng, m) if rng.random() < 0.4 else None
    handles = some_vertices(rng, m) if rng.random() < 0.3 else None
    if pins is not None and handles is not None:
        handles = None
    solver = dp.PoissonSolver(m, pins=pins, handles=handles)
    a: Arguments = {"solver": solver, "R": R}
    if pins is not None:
        a["pins"] = torch.from_numpy(rng.normal(size=(*batch, len(pins), c)))
    if handles is not None:
        a["handles"] = torch.from_numpy(rng.normal(size=(len(handles), c)))
    if rng.random() < 0.2:
        a["translations"] = torch.from_numpy(rng.normal(size=(solver.n_floating, c)))
    if rng.random() < 0.2:
        a["vertices"] = m.vertices.clone()
    return a


def _call_solver(solver: dp.PoissonSolver, **arguments: Any) -> Tensor:
    return solver(**arguments)


def _draw_transformed(rng: Rng) -> Arguments:
    m = mesh(rng)
    R = matrices(rng, m)
    c = R.shape[-2]
    return {
        "solver": dp.PoissonSolver(m),
        "R": R,
        "transforms": torch.from_numpy(rng.normal(size=(m.n_faces, c, c))),
        "face_weights": torch.ones(m.n_faces, dtype=torch.float64),
    }


def _check_transformed(a: Arguments, phi: Tensor) -> None:
    if a["transforms"] is None:
        check_solution(a, phi)
        return
    R = (a["transforms"].double() @ a["R"].double()).to(a["R"].dtype)
    require(phi.shape[-2:] == (a["solver"].mesh.n_vertices, R.shape[-2]), "shape")
    if sound(a["R"], a["transforms"], R) and a["R"].dtype in (torch.float32, torch.float64):
        require(phi.isfinite().all(), "finite")


def _draw_laplacian_solve(rng: Rng) -> Arguments:
    m = mesh(rng)
    columns = torch.from_numpy(rng.normal(size=(m.n_vertices, int(rng.integers(0, 4)))))
    return {"solver": dp.PoissonSolver(m), "b": columns}


def _draw_jacobians(rng: Rng) -> Arguments:
    m = mesh(rng)
    phi = field(rng, m, m.n_vertices, int(rng.integers(0, 4)))
    a: Arguments = {"mesh": m, "phi": phi, "extrinsic": bool(rng.integers(2))}
    return a | ({"vertices": m.vertices.clone()} if rng.random() < 0.3 else {})


def _draw_divergence(rng: Rng) -> Arguments:
    m = mesh(rng)
    a = {"mesh": m, "R": matrices(rng, m)}
    return a | ({"vertices": m.vertices.clone()} if rng.random() < 0.3 else {})


def _draw_restrict(rng: Rng) -> Arguments:
    m = mesh(rng)
    return {"P": field(rng, m, m.n_faces, 2, m.dim), "frames": m.frames.clone()}


def _draw_extend(rng: Rng) -> Arguments:
    m = mesh(rng)
    return {"R": field(rng, m, m.n_faces, 2, m.cell_dim), "frames": m.frames.clone()}


def _draw_density(rng: Rng) -> Arguments:
    c, d = [(2, 2), (3, 2), (3, 3)][rng.integers(3)]
    J = torch.from_numpy(rng.normal(size=(int(rng.integers(0, 5)), c, d)))
    J = J * 10.0 ** rng.uniform(-3, 3) if rng.random() < 0.3 else J
    return {"J": J.float() if rng.random() < 0.3 else J}


def _draw_barrier(rng: Rng) -> Arguments:
    return _draw_density(rng) | {"epsilon": float(rng.choice([0, 1e-3, 1.0]))}


def _draw_arrays(rng: Rng) -> Arguments:
    vertices, faces = arrays(rng)
    return {"vertices": vertices, "faces": faces}


def _draw_moved(rng: Rng) -> Arguments:
    m = mesh(rng)
    return {"self": m, "vertices": 2 * m.vertices}


def _draw_union(rng: Rng) -> Arguments:
    first = mesh(rng)
    return {"meshes": [first, first.with_vertices(first.vertices * 3)]}


def _draw_solvers(rng: Rng) -> Arguments:
    first = mesh(rng)
    return {"solvers": [dp.PoissonSolver(first), dp.PoissonSolver(first)]}


def _draw_split(rng: Rng) -> Arguments:
    m = dp.Mesh.concatenate([mesh(rng)] * 2)
    return {"self": m, "values": torch.from_numpy(rng.normal(size=(m.n_vertices, 2))), "dim": 0}


def _draw_to(rng: Rng) -> Arguments:
    return {"self": mesh(rng), "target": str(rng.choice(["cpu", "meta"]))}


def _draw_spectral(rng: Rng) -> Arguments:
    return {"mesh": mesh(rng), "n_eigenpairs": int(rng.integers(1, 6)), "mass": "barycentric"}


def _draw_signature(rng: Rng) -> Arguments:
    return _draw_spectral(rng) | {"n_energies": int(rng.integers(1, 9))}


def _draw_heat(rng: Rng) -> Arguments:
    return _draw_spectral(rng) | {"times": torch.from_numpy(rng.uniform(0, 2, 3))}


def _draw_samples(rng: Rng) -> Arguments:
    return {"mesh": mesh(rng), "n_samples": int(rng.integers(0, 20))}


def _draw_interpolation(rng: Rng) -> Arguments:
    m = mesh(rng)
    while m.cell_dim == 3:
        m = mesh(rng)
    return {
        "samples": dp.sample_surface(m, 5),
        "mesh": m,
        "values": field(rng, m, m.n_vertices, 2),
    }


def _draw_disk(rng: Rng) -> Arguments:
    m = dp.Mesh(*meshes.disk(int(rng.integers(100)), 4)) if rng.random() < 0.7 else mesh(rng)
    return {"mesh": m}


def _draw_slim(rng: Rng) -> Arguments:
    m = dp.Mesh(*meshes.disk(int(rng.integers(100)), 4))
    return {"mesh": m, "init": dp.tutte(m), "tolerance": 1e-3, "max_iterations": 3}


def _rotated(rng: Rng) -> tuple[int, int]:
    return ((2, 2), (3, 2), (3, 3))[int(rng.integers(3))]


def check_rotations(a: Arguments, Q: Tensor) -> None:
    """Orthonormal columns, with a symmetric product; right-handed where square."""
    require(Q.shape == a["J"].shape, "shape")
    if not sound(a["J"]):
        return
    rounding, Q = torch.finfo(Q.dtype).eps, Q.double()
    require(((Q.mT @ Q - torch.eye(Q.shape[-1])).abs() < 20 * rounding).all(), "orthonormal")
    if Q.shape[-1] == Q.shape[-2]:
        require((torch.linalg.det(Q) > 0).all(), "right-handed")
    J = a["J"].double()
    J = J / J.abs().amax((-2, -1), keepdim=True).clamp(min=torch.finfo(torch.float64).tiny)
    product = Q.mT @ J
    require(((product - product.mT).abs() < 50 * rounding).all(), "closest")


def _draw_rigid(rng: Rng) -> Arguments:
    """Few steps, or steps to a tolerance that may be out of reach: then None, for no tolerance."""
    m = mesh(rng)
    kind = str(rng.choice(["pins", "handles"]))
    chosen = some_vertices(rng, m)
    images = m.vertices[chosen].double() + torch.from_numpy(rng.normal(size=(len(chosen), m.dim)))
    solver = dp.PoissonSolver(m, **{kind: chosen})
    return {"solver": solver, kind: images, "tolerance": None, "max_steps": int(rng.integers(1, 4))}


def _rigid(**arguments: Any) -> dp.RigidMap:
    try:
        return dp.RigidMap(*(x.detach() for x in dp.as_rigid_as_possible(**arguments)))
    except RuntimeError as error:  # a tolerance that a spoilt argument brought in
        require("not converged" in str(error), "an error that says so")
        raise ValueError(str(error)) from error


def check_rigid(a: Arguments, result: dp.RigidMap) -> None:
    """Finite, pins met, energies that never grow."""
    m = a["solver"].mesh
    given = a.get("pins", a.get("handles"))
    require(result.vertices.shape[-2] == m.n_vertices, "shape")
    require(result.vertices.dtype == given.dtype, "dtype")
    if not all(sound(x) for x in a.values() if isinstance(x, Tensor)):
        return
    require(result.vertices.isfinite().all(), "finite")
    size = max(float(given.abs().max()), float(m.vertices.abs().max()))
    if "pins" in a:
        missed = result.vertices[..., a["solver"].constraints.pins, :] - given
        require(float(missed.abs().max()) <= 1e-5 * size, "pins")
    # Each gradient is right up to roundings of the terms it sums, which thin cells make large.
    x = result.vertices.detach().double().reshape(-1, m.n_vertices, m.dim).abs().amax(0).numpy()
    terms = np.abs(gradient_operator(m).matrix) @ x
    weights = np.tile(m._double_measures.numpy(), m.cell_dim)
    scale = float(weights @ (terms**2).sum(1)) + float(weights.sum())
    growth = result.energies[..., 1:] - result.energies[..., :-1]
    require(
        (growth <= (1e5 * unit(torch.float64) + 100 * unit(given.dtype)) * scale).all(), "energies"
    )


def _draw_planar(rng: Rng) -> Arguments:
    """A disk with a map that is flat, perturbed, or noise."""
    m = dp.Mesh(*meshes.disk(int(rng.integers(100)), 4))
    noise = rng.choice([0, 0.2, 1]) * torch.from_numpy(rng.normal(size=(m.n_vertices, 2)))
    return {"mesh": m, "uv": dp.tutte(m) + noise}


def _draw_clamp_flips(rng: Rng) -> Arguments:
    a = _draw_planar(rng)
    return {"solver": dp.PoissonSolver(a["mesh"]), "uv": a["uv"], "max_rounds": 3}


def _draw_untangle(rng: Rng) -> Arguments:
    return _draw_planar(rng) | {"max_rounds": 2, "iterations": 5}


def _draw_parameterize(rng: Rng) -> Arguments:
    a = _draw_planar(rng)
    return {"mesh": a["mesh"], "init": a["uv"], "tolerance": 1e-3, "max_iterations": 3}


def _draw_clamped(rng: Rng) -> Arguments:
    J = torch.from_numpy(rng.normal(size=(int(rng.integers(0, 5)), 2, 2)))
    return {"J": J, "smallest": 0.25, "largest": float(rng.choice([0.25, 4]))}


def _draw_one_shot(rng: Rng) -> Arguments:
    a = _draw_solve(rng)
    solver = a.pop("solver")
    constraints = solver.constraints
    kept = {"mesh": solver.mesh, "R": a["R"]}
    return kept | ({"face_weights": constraints.face_weights.clone()} if rng.random() < 0.5 else {})


def _check_one_shot(a: Arguments, phi: Tensor) -> None:
    weights = a.get("face_weights")
    solver = dp.PoissonSolver(a["mesh"], face_weights=weights)
    check_solution({"solver": solver, "R": a["R"]}, phi)


def _draw_procrustes(rng: Rng) -> Arguments:
    source, target = torch.from_numpy(rng.normal(size=(2, 6, 2)))
    return {
        "source": source,
        "target": target,
        "weights": torch.from_numpy(rng.uniform(0.1, 1, 6)),
        "reflect": bool(rng.integers(2)),
    }


OPERATIONS: dict[str, Operation] = {
    "Mesh": Operation(_draw_arrays, dp.Mesh, check_mesh, 6),
    "Mesh.cleaned": Operation(
        _draw_arrays, dp.Mesh.cleaned, lambda a, cleaned: check_mesh(a, cleaned.mesh), 2
    ),
    "Mesh.with_vertices": Operation(
        _draw_moved, lambda self, vertices: self.with_vertices(vertices), check_mesh
    ),
    "Mesh.to": Operation(_draw_to, lambda self, target: self.to(target), check_mesh, 0.3),
    "Mesh.concatenate": Operation(_draw_union, dp.Mesh.concatenate, check_mesh, 0.5),
    "Mesh.split_vertices": Operation(
        _draw_split, lambda self, **a: self.split_vertices(**a), check_parts
    ),
    "jacobians": Operation(_draw_jacobians, dp.jacobians, check_jacobians, 3),
    "divergence": Operation(_draw_divergence, dp.divergence, check_divergence, 3),
    "laplacian": Operation(lambda rng: {"mesh": mesh(rng)}, dp.laplacian, check_laplacian, 0.3),
    "restrict": Operation(_draw_restrict, dp.restrict, partial(check_same_shape, "P")),
    "extend": Operation(_draw_extend, dp.extend, partial(check_same_shape, "R")),
    "PoissonSolver": Operation(_draw_solver, _make_solver, _check_solver, 4),
    "PoissonSolver.__call__": Operation(_draw_solve, _call_solver, check_solution, 6),
    "PoissonSolver transforms": Operation(_draw_transformed, _call_solver, _check_transformed, 2),
    "solve_laplacian": Operation(
        _draw_laplacian_solve,
        lambda solver, b: solver.solve_laplacian(b),
        check_laplacian_solution,
    ),
    "PoissonSolver.concatenate": Operation(
        _draw_solvers, dp.PoissonSolver.concatenate, _check_solver
    ),
    "laplacian_eigenpairs": Operation(_draw_spectral, dp.laplacian_eigenpairs, check_eigenpairs),
    "wave_kernel_signature": Operation(
        _draw_signature, dp.wave_kernel_signature, check_signature, 0.5
    ),
    "heat_kernel_signature": Operation(_draw_heat, dp.heat_kernel_signature, check_signature, 0.5),
    "lumped_mass": Operation(
        lambda rng: {"mesh": mesh(rng), "mass": str(rng.choice(["barycentric", "voronoi"]))},
        dp.lumped_mass,
        check_mass,
        0.5,
    ),
    "sample_surface": Operation(_draw_samples, dp.sample_surface, check_samples, 0.5),
    "interpolate": Operation(
        _draw_interpolation,
        lambda samples, **a: samples.interpolate(**a),
        lambda a, value: require(value.shape[-2:] == (5, a["values"].shape[-1]), "shape"),
    ),
    "tutte": Operation(_draw_disk, dp.tutte, check_uv, 0.5),
    "slim": Operation(_draw_slim, dp.slim, lambda a, result: check_uv(a, result.uv), 0.5),
    "as_rigid_as_possible": Operation(_draw_rigid, _rigid, check_rigid),
    "closest_rotation": Operation(
        lambda rng: {"J": torch.from_numpy(rng.normal(size=(4, *_rotated(rng))))},
        dp.closest_rotation,
        check_rotations,
        0.4,
    ),
    "solve_poisson": Operation(_draw_one_shot, dp.solve_poisson, _check_one_shot),
    "parameterize": Operation(_draw_parameterize, dp.parameterize, check_parameterized, 0.3),
    "certify": Operation(_draw_planar, dp.certify, check_certificate, 0.7),
    "clamp_flips": Operation(_draw_clamp_flips, dp.clamp_flips, check_repaired, 0.5),
    "untangle": Operation(_draw_untangle, dp.untangle, check_repaired, 0.3),
    "clamp_singular_values": Operation(_draw_clamped, dp.clamp_singular_values, check_clamped, 0.4),
    "procrustes": Operation(_draw_procrustes, dp.procrustes, check_procrustes),
    **{
        name: Operation(_draw_density, getattr(dp, name), check_density, 0.4)
        for name in (
            *("singular_values", "determinant", "flipped", "isometric_distortion", "arap", "lscm"),
        )
    },
    **{
        name: Operation(_draw_barrier, getattr(dp, name), check_density, 0.4)
        for name in ("symmetric_dirichlet", "mips", "area_distortion", "isometric_amips")
    },
}
_NAMES = list(OPERATIONS)
_SELVES = {"self", "solver", "samples"}  # not spoilt: without them there is no method to call
_WEIGHTS = np.array([operation.weight for operation in OPERATIONS.values()])

# Messages begin with the name of what raises, which may be what the operation calls.
_SPEAKERS = (
    *("Mesh", "PoissonSolver", "distortion", "CholeskyFactor", "solve_laplacian", "lumped_mass"),
    *("laplacian_eigenpairs", "singular_values", "areas need", "volumes need", "vertex_areas need"),
    *("slim", "tutte", "clamp_singular_values", "jacobians"),
)


# ------------------------------------------------------- one case


def run_case(seed: int, index: int) -> dict[str, Any]:
    """Draw, spoil, call, judge."""
    rng = np.random.default_rng((seed, index))
    torch.manual_seed(index)
    name = str(rng.choice(_NAMES, p=_WEIGHTS / _WEIGHTS.sum()))
    operation = OPERATIONS[name]
    record = {"index": index, "operation": name, "outcome": "answered", "spoilt": []}
    try:
        arguments = operation.draw(rng)
        for _ in range(rng.choice(3, p=[0.1, 0.7, 0.2])):
            key = str(rng.choice(sorted(set(arguments) - _SELVES)))
            if isinstance(arguments[key], bool):
                continue
            if key == "mesh" and len(arguments) > 1 and rng.random() < 0.7:
                continue
            how, arguments[key] = spoil(arguments[key], rng)
            record["spoilt"].append(f"{key}: {how}")
        result = operation.call(**arguments)
        arguments = {k: x.detach() if isinstance(x, Tensor) else x for k, x in arguments.items()}
        result = result.detach() if isinstance(result, Tensor) else result
    except REFUSALS as error:
        record["outcome"] = "refused"
        speakers = (name, name.rsplit(".", maxsplit=1)[-1], *_SPEAKERS)
        if not str(error).startswith(speakers):
            record |= {"outcome": "unnamed error", "error": _describe(error)}
        return record
    except (Exception, Warning) as error:
        return record | {"outcome": "other exception", "error": _describe(error)}
    try:
        operation.check(arguments, result)
    except WrongAnswerError as error:
        record |= {"outcome": "wrong answer", "error": str(error)}
    except (Exception, Warning) as error:
        record |= {"outcome": "unchecked", "error": _describe(error)}
    return record


def _describe(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "/diffpoisson/" in f.filename or "/tests/" in f.filename]
    places = " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in reversed(ours[-3:]))
    return f"{type(error).__name__}: {str(error)[:300]} ({places})"


# ------------------------------------------------------- many, in processes


def _work(seed: int, start: int, stop: int, current: Any, results: Any) -> None:
    torch.set_num_threads(1)
    warnings.simplefilter("error")
    warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
    for index in range(start, stop):
        current.value = index
        results.put(run_case(seed, index))
    results.close()
    results.join_thread()


class Worker:
    """A process that runs a range of cases, and is replaced if one of them kills or hangs it."""

    def __init__(self, seed: int, start: int, stop: int, timeout: float) -> None:
        self.seed, self.stop, self.timeout = seed, stop, timeout
        self._context = mp.get_context("spawn")
        self._start(start)

    def _start(self, start: int) -> None:
        self.done = start  # every case below is accounted for
        self._current = self._context.Value("q", start)
        self._results = self._context.Queue()
        self._process = self._context.Process(
            target=_work, args=(self.seed, start, self.stop, self._current, self._results)
        )
        self._process.start()
        self._seen = time.monotonic()

    def poll(self) -> list[dict[str, Any]]:
        """The records that came in since the last call."""
        alive = self._process.is_alive()
        records = []
        while not self._results.empty():
            records.append(self._results.get())
        if records:
            self.done, self._seen = records[-1]["index"] + 1, time.monotonic()
        elif self.done < self.stop:
            silent = time.monotonic() - self._seen > self.timeout
            if not alive or silent:
                records.append(self._fatal("hang" if alive else "crash"))
        return records

    def _fatal(self, outcome: str) -> dict[str, Any]:
        self._process.kill()
        self._process.join()
        code, index = self._process.exitcode, self._current.value
        self._start(index + 1)
        return {
            "index": index,
            "operation": "?",
            "outcome": outcome,
            "spoilt": [],
            "error": f"exit code {code}",
        }


def run(n: int, seed: int, workers: int, state: Path | None, timeout: float = 120) -> dict:
    """Run cases 0 … n - 1 in chunks; `state` keeps what is done, for the next run."""
    chunk = 2000
    summary: dict[str, Any] = {"seed": seed, "done": 0, "counts": {}, "findings": []}
    if state and state.exists():
        before = json.loads(state.read_text())
        if before["seed"] == seed:
            summary = before | {"findings": []}
            for finding in before["findings"]:
                _move(summary, finding["outcome"], run_case(seed, finding["index"]))
            _save(summary, state)
    with tqdm(total=n, initial=summary["done"], disable=not sys.stderr.isatty()) as bar:
        while summary["done"] < n:
            first, last = summary["done"], min(summary["done"] + chunk, n)
            cuts = np.linspace(first, last, workers + 1).astype(int).tolist()
            pool = [Worker(seed, *ends, timeout) for ends in pairwise(cuts)]
            while any(worker.done < worker.stop for worker in pool):
                time.sleep(0.05)
                for record in (r for worker in pool for r in worker.poll()):
                    _count(summary, record)
                    bar.update()
            summary["done"] = last
            if state:
                _save(summary, state)
    return summary


def _save(summary: dict[str, Any], state: Path) -> None:
    state.parent.mkdir(parents=True, exist_ok=True)
    state.write_text(json.dumps(summary, indent=1) + "\n")


def _count(summary: dict[str, Any], record: dict[str, Any]) -> None:
    counts = Counter(summary["counts"].get(record["operation"], {}))
    counts[record["outcome"]] += 1
    summary["counts"][record["operation"]] = dict(counts)
    if record["outcome"] not in ("answered", "refused"):
        summary["findings"].append(record)


def _move(summary: dict[str, Any], outcome: str, record: dict[str, Any]) -> None:
    """Count a case that was run again."""
    summary["counts"][record["operation"]][outcome] -= 1
    _count(summary, record)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--case", type=int, help="run one case here, and show it")
    arguments = parser.parse_args()
    if arguments.case is not None:
        print(json.dumps(run_case(arguments.seed, arguments.case), indent=1))
        return
    summary = run(arguments.n, arguments.seed, arguments.workers, arguments.json)
    totals = sum((Counter(c) for c in summary["counts"].values()), Counter())
    print(dict(totals))
    for finding in summary["findings"]:
        print(json.dumps(finding))
    sys.exit(bool(summary["findings"]))


if __name__ == "__main__":
    main()
