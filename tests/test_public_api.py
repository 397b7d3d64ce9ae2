"""What others import: the list of names, their documentation, and silence."""

from __future__ import annotations

import inspect
import subprocess
import sys
from importlib import resources

import pytest

import diffpoisson as dp

NAMES = [
    "Certificate",
    "Chart",
    "CleanedMesh",
    "Mesh",
    "MeshError",
    "PoissonSolver",
    "RigidMap",
    "SlimResult",
    "SurfaceSamples",
    "UVMap",
    "arap",
    "area_distortion",
    "as_rigid_as_possible",
    "certify",
    "clamp_flips",
    "clamp_singular_values",
    "closest_rotation",
    "determinant",
    "divergence",
    "extend",
    "flipped",
    "heat_kernel_signature",
    "isometric_amips",
    "isometric_distortion",
    "jacobians",
    "laplacian",
    "laplacian_eigenpairs",
    "lscm",
    "lumped_mass",
    "mips",
    "parameterize",
    "procrustes",
    "restrict",
    "sample_surface",
    "singular_values",
    "slim",
    "solve_poisson",
    "symmetric_dirichlet",
    "tutte",
    "untangle",
    "wave_kernel_signature",
]


def test_names():
    """Adding a name is a decision; removing one breaks someone's code."""
    assert dp.__all__ == NAMES
    assert all(hasattr(dp, name) for name in NAMES)


@pytest.mark.parametrize("name", dp.__all__)
def test_documented_and_annotated(name):
    """Own docstrings, on public members too, and a type on every argument and result."""
    public = getattr(dp, name)
    members = [public]
    if inspect.isclass(public):
        own = [m for key, m in vars(public).items() if not key.startswith("_")]
        members += [m for m in own if inspect.isfunction(m) or isinstance(m, property)]
    for member in members:
        assert member.__doc__
        assert member.__doc__.strip()
    for function in filter(inspect.isfunction, members):
        signature = inspect.signature(function)
        given = [p for p in signature.parameters.values() if p.name not in ("self", "cls")]
        assert all(p.annotation is not p.empty for p in given)
        assert signature.return_annotation is not signature.empty


def test_typed_marker_is_shipped():
    for package in ("diffpoisson", "njf_models"):
        assert resources.files(package).joinpath("py.typed").is_file()


SESSION = """
import numpy as np
import torch
import diffpoisson as dp
vertices = np.array([[0., 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
mesh = dp.Mesh(vertices, faces)
unused = dp.PoissonSolver(mesh)
solver = dp.PoissonSolver(mesh)
R = dp.jacobians(mesh, mesh.vertices).requires_grad_()
dp.symmetric_dirichlet(dp.jacobians(mesh, solver(R))).sum().backward()
dp.wave_kernel_signature(mesh, n_eigenpairs=4)
dp.sample_surface(mesh, 5)
dp.PoissonSolver.concatenate([solver, solver])
"""


@pytest.mark.parametrize(
    "code", ["import diffpoisson", "import njf_models", SESSION], ids=["core", "models", "session"]
)
def test_silent(code):
    """No print and no warning, at import, in use, or at exit."""
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


def test_models_are_imported_on_demand_only():
    """The core does not pull in what training needs."""
    code = (
        "import sys, diffpoisson; print([m for m in ('lightning', 'trimesh', 'njf_models', "
        "'matplotlib', 'hypothesis') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "[]\n"
