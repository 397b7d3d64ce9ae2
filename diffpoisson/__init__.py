"""Differentiable geometry processing: Jacobians, Poisson solves, distortion on triangle meshes."""

from __future__ import annotations

from diffpoisson.certificate import Certificate, certify
from diffpoisson.distortion import (
    arap,
    area_distortion,
    closest_rotation,
    determinant,
    flipped,
    isometric_amips,
    isometric_distortion,
    lscm,
    mips,
    singular_values,
    symmetric_dirichlet,
)
from diffpoisson.gradient import divergence, jacobians, laplacian
from diffpoisson.mesh import CleanedMesh, Mesh, MeshError
from diffpoisson.parameterization import SlimResult, procrustes, slim, tutte
from diffpoisson.poisson import PoissonSolver, solve_poisson
from diffpoisson.repair import clamp_flips, clamp_singular_values, untangle
from diffpoisson.restriction import extend, restrict
from diffpoisson.rigid import RigidMap, as_rigid_as_possible
from diffpoisson.sampling import SurfaceSamples, sample_surface
from diffpoisson.spectral import (
    heat_kernel_signature,
    laplacian_eigenpairs,
    lumped_mass,
    wave_kernel_signature,
)
from diffpoisson.uvmap import Chart, UVMap, parameterize

__all__ = [
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
