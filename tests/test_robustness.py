"""What happens around a solver: NaN, copies, worker processes, interpreter exit, memory."""

from __future__ import annotations

import copy
import pickle
import platform
import subprocess
import sys

import pytest
import torch
from torch.utils.data import DataLoader, Dataset

import diffpoisson as dp
from diffpoisson.factor import CholeskyFactor
from diffpoisson.gradient import gradient_operator
from diffpoisson.linear_map import LinearMap
from tests import meshes
from tests.benchmarks import leaks
from tests.benchmarks.conditioning import caps, needles
from tests.checks import field

# ------------------------------------------------------- NaN stays where it must


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_bad_entry_stays_in_its_column_of_its_field(bad):
    """Only the column of the batch element that it is in has to suffer."""
    mesh = dp.Mesh(*meshes.parts())
    R = field(mesh, batch=(2,))
    R[1, 5, 2, 0] = bad
    for operator in (dp.PoissonSolver(mesh), lambda R: dp.divergence(mesh, R)):
        phi = operator(R)
        assert not phi[1, :, 2].isfinite().all()
        assert phi[0].isfinite().all()
        assert phi[1, :, :2].isfinite().all()
    phi = torch.randn(2, mesh.n_vertices, 3, dtype=torch.float64)
    phi[1, 0, 2] = bad
    J = dp.jacobians(mesh, phi)
    touched = (mesh.faces == 0).any(1)
    assert not J[1, touched, 2].isfinite().any()
    J[1, touched, 2] = 0
    assert J.isfinite().all()


def test_a_nan_stays_in_its_component():
    """Also where another component is held, and takes no part in the gauge."""
    mesh = dp.Mesh.concatenate([dp.Mesh(*meshes.disk(seed)) for seed in range(3)])
    R = field(mesh)
    R[mesh.part_of_face == 1] = torch.nan
    pins = torch.tensor([0])
    images = torch.zeros(1, 3, dtype=torch.float64)
    for first_held in (False, True):
        solver = dp.PoissonSolver(mesh, pins=pins if first_held else None)
        phi = solver(R, pins=images if first_held else None)
        assert (phi.isnan().any(1) == (mesh.part_of_vertex == 1)).all()
    solver = dp.PoissonSolver(mesh, pins=torch.tensor([mesh.vertex_offsets[1]]))
    assert solver(R, pins=images).isfinite()[mesh.part_of_vertex != 1].all()


def test_a_nan_stays_in_its_part_of_a_batch():
    solvers = [dp.PoissonSolver(dp.Mesh(*meshes.disk(seed))) for seed in range(3)]
    union = dp.PoissonSolver.concatenate(solvers)
    R = field(union.mesh)
    R[union.mesh.part_of_face == 1] = torch.nan
    assert (union(R).isnan().any(1) == (union.mesh.part_of_vertex == 1)).all()


@pytest.mark.parametrize("shape", [(2, 2), (3, 2), (3, 3)])
def test_a_nan_stays_in_its_jacobian_and_counts_as_flipped(shape):
    J = torch.eye(3, dtype=torch.float64)[: shape[0], : shape[1]].repeat(4, 1, 1)
    J[2, 0, 1] = torch.nan
    assert dp.flipped(J).tolist() == [False, False, True, False]
    for name in ("singular_values", "arap", "symmetric_dirichlet", "mips", "isometric_distortion"):
        value = getattr(dp, name)(J)
        assert value[[0, 1, 3]].isfinite().all()
        assert not value[2].isfinite().all()


# ------------------------------------------------------- copies, in this process and in others


def _copies(value):
    return copy.deepcopy(value), copy.copy(value), pickle.loads(pickle.dumps(value))


def test_copies_of_a_mesh():
    mesh = dp.Mesh.concatenate([dp.Mesh(*meshes.disk()), dp.Mesh(*meshes.torus())])
    assert mesh.components.max() == 1  # cached properties are not carried, or are right
    for twin in _copies(mesh):
        assert torch.equal(twin.vertices, mesh.vertices)
        assert torch.equal(twin.faces, mesh.faces)
        assert torch.equal(twin.components, mesh.components)
        assert torch.equal(dp.jacobians(twin, twin.vertices), dp.jacobians(mesh, mesh.vertices))
        assert [len(x) for x in twin.split_faces(twin.faces)] == [32, 70]


def test_copies_of_a_solver():
    """With everything that it was given; the factor is made again."""
    mesh = dp.Mesh(*meshes.parts())
    options = {
        "pins": torch.tensor([3, 5]),
        "handles": torch.tensor([20]),
        "handle_weights": 0.3,
        "face_weights": torch.linspace(0.5, 1, mesh.n_faces).double(),
    }
    images = {
        "pins": torch.ones(2, 3, dtype=torch.float64),
        "handles": torch.zeros(1, 3, dtype=torch.float64),
    }
    R = field(mesh)
    solver = dp.PoissonSolver(mesh, **options)
    expected = solver(R, **images)
    union = dp.PoissonSolver.concatenate([dp.PoissonSolver(mesh), dp.PoissonSolver(mesh)])
    for twin in _copies(solver):
        assert torch.equal(twin(R, **images), expected)
    for twin in _copies(union):
        assert torch.equal(twin(torch.cat([R, R])), union(torch.cat([R, R])))


def test_copies_of_maps():
    mesh = dp.Mesh(*meshes.disk())
    x = torch.arange(3.0 * mesh.n_vertices, dtype=torch.float64).reshape(-1, 3)
    gradient = gradient_operator(mesh).gradient
    inverse = LinearMap(CholeskyFactor(dp.laplacian(mesh)[1:, 1:]))
    for A, b in ((gradient, x), (gradient.T, gradient(x)), (inverse, x[1:])):
        for twin in _copies(A):
            assert torch.equal(twin(b), A(b))
            assert torch.equal(twin.T.T(b), A(b))


class Solves(Dataset):
    """A dataset that carries a solver to its workers."""

    def __init__(self) -> None:
        mesh = dp.Mesh(*meshes.disk())
        self.solver, self.R = dp.PoissonSolver(mesh), field(mesh, batch=(4,))

    def __len__(self) -> int:
        return len(self.R)

    def __getitem__(self, i: int) -> torch.Tensor:
        return self.solver(self.R[i])


@pytest.mark.parametrize("context", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_data_loader_workers(context):
    dataset = Solves()
    expected = torch.stack([dataset[i] for i in range(len(dataset))])
    loader = DataLoader(dataset, num_workers=2, batch_size=2, multiprocessing_context=context)
    assert torch.equal(torch.cat(list(loader)), expected)


# ------------------------------------------------------- silence at exit

PREPARE = """
import torch, diffpoisson as dp
vertices = torch.tensor([[0., 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.3]], dtype=torch.float64)
mesh = dp.Mesh(vertices, torch.tensor([[0, 1, 2], [1, 3, 2]]))
R = dp.jacobians(mesh, mesh.vertices)
"""
ENDINGS = {
    # One process for all: each takes seconds to start.
    "at module level, unused, in a closure, a cycle, a graph, a union": """
used, unused = dp.PoissonSolver(mesh), dp.PoissonSolver(mesh)
used(R)
def layer():
    solver = dp.PoissonSolver(mesh)
    return lambda R: solver(R)
f = layer(); f(R)
solver = dp.PoissonSolver(mesh); solver.itself = solver; solver(R); del solver
phi = dp.PoissonSolver(mesh)(R.clone().requires_grad_())
union = dp.PoissonSolver.concatenate(2 * [dp.PoissonSolver(mesh)]); union(torch.cat([R, R]))
""",
    "compiled": """
solver = dp.PoissonSolver(mesh)
f = torch.compile(lambda R: solver(R), backend="aot_eager", fullgraph=True); f(R)
""",
    "in a thread": """
import threading
solver = dp.PoissonSolver(mesh)
thread = threading.Thread(target=solver, args=(R,)); thread.start(); thread.join()
""",
    "in forked workers": """
from torch.utils.data import DataLoader
solver = dp.PoissonSolver(mesh); solver(R)
list(DataLoader([R, R], num_workers=1, multiprocessing_context="fork",
     collate_fn=lambda x: solver(torch.stack(x))))
""",
}


@pytest.mark.parametrize("ending", ENDINGS)
def test_silent_exit(ending):
    """cholespy's bindings report what is alive when the interpreter ends."""
    assert _session(PREPARE + ENDINGS[ending]) == (0, "", "")


def test_silent_exit_after_an_exception():
    raises = "solver = dp.PoissonSolver(mesh); solver(R); solver(R[:1])"
    code, out, err = _session(PREPARE + raises)
    assert (code, out) == (1, "")
    last = err.strip().splitlines()[-1]
    assert last.startswith("ValueError: PoissonSolver: expected one matrix per face")
    assert "leak" not in err


def _session(code: str) -> tuple[int, str, str]:
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    return run.returncode, run.stdout, run.stderr


# ------------------------------------------------------- memory


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="asks glibc for its memory")
def test_cycles_lose_no_memory():
    """300 solvers, built, used and dropped; cholespy alone would lose 11 MB."""
    run = [sys.executable, "-m", "tests.benchmarks.leaks", "--cycles", "300", "--variant"]

    def growth(variant: str) -> float:
        out = subprocess.run([*run, variant], capture_output=True, text=True, check=True).stdout
        return leaks.json.loads(out.splitlines()[-1])["300"]

    assert growth("ours") < 2


# ------------------------------------------------------- thin faces


@pytest.mark.parametrize("shape", [needles, caps])
@pytest.mark.parametrize("aspect", [1e2, 1e4, 1e6])
def test_thin_faces_cost_the_square_of_their_aspect(shape, aspect):
    """An affine map, which is known; never the error of a shift."""
    mesh = dp.Mesh(*shape(aspect))
    areas = mesh.vertex_areas[:, None]
    expected = mesh.vertices - (areas * mesh.vertices).sum(0) / areas.sum()
    phi = dp.PoissonSolver(mesh)(dp.jacobians(mesh, mesh.vertices))
    condition = mesh.n_vertices * aspect**2  # of the Laplacian, roughly
    assert (phi - expected).abs().max() < torch.finfo(phi.dtype).eps * condition


@pytest.mark.parametrize("shape", [needles, caps])
@pytest.mark.parametrize("aspect", [1e8, 1e9, 1e10, 1e11])
def test_too_thin_faces_raise_and_are_named(shape, aspect):
    """Also where rounding happens to leave the Laplacian positive definite."""
    mesh = dp.Mesh(*shape(aspect))
    with pytest.raises(dp.MeshError, match=f"thinnest face, {_thinnest(mesh)}, has a height of"):
        dp.PoissonSolver(mesh)


def _thinnest(mesh: dp.Mesh) -> int:
    """The face with the least height over its longest edge."""
    corners = mesh.vertices[mesh.faces]
    longest = (corners - corners.roll(1, dims=1)).norm(dim=-1).max(dim=1).values
    return int((mesh.areas / longest**2).argmin())
