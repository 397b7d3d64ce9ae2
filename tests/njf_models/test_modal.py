"""A field of few functions, pinned to handles, whose rounds read how a map is strained."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import Shape
from njf_models import modal_training as training
from njf_models.baselines.global_mlp import GlobalMLP
from njf_models.contact_maps import block_handles, block_shape
from njf_models.datasets.arap import build_arap
from njf_models.datasets.contact import make_scene
from njf_models.elastic_maps import evaluate_elastic, solid_handles, summarise
from njf_models.experiments import mean, spread
from njf_models.handles import Handles
from njf_models.losses import paper_loss
from njf_models.metrics import l2_vertices
from njf_models.modal_njf import Basis, ModalNJF, closest_isometry
from njf_models.modal_training import KnownMaps, fit_modal, load_modal, modal_in
from njf_models.njf import Prediction
from tests.njf_models.shapes import bumpy_disk
from tests.njf_models.test_elastic import SETTINGS, block

SPLIT = slice(16), slice(16, None)
SIZES = {"rank": 8, "width": 16, "code_width": 16}


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    return build_arap(tmp_path_factory.mktemp("maps"), 24, block(), SETTINGS, progress=False)


def surface(solid, reach=SETTINGS.reach) -> Shape:
    shape = Shape.prepare(dp.Mesh(solid.vertices[solid.surface], solid.faces))
    return shape.with_handles(solid_handles(solid, shape.mesh, reach))


@pytest.fixture(scope="module")
def shape(maps):
    return surface(maps.solid)


def random_model(seed: int = 0, **options) -> ModalNJF:
    torch.manual_seed(seed)
    model = ModalNJF(6, 6, **{**SIZES, **options})
    for network in (model.first, model.correction, model.step):
        for parameter in network.parameters():
            torch.nn.init.normal_(parameter, std=0.2)
    return model.eval().requires_grad_(False)


# ------------------------------------------------------- handles


def test_handles_of_a_solid_are_where_its_maps_have_them(maps, shape):
    positions = shape.handles.positions(maps.parameters)
    assert_close(positions.float(), maps.positions[:, maps.held])
    for number in range(2):
        assert_close(positions[number], maps.held_positions(number), rtol=0, atol=1e-7)


def test_ends_of_the_block_are_where_the_scene_puts_them():
    scene, shift = make_scene(12), 0.25
    shape = block_shape(scene)
    handles = block_handles(scene, shape.mesh, shift)
    motions = np.array([[[0.1, -0.2, 0.7], [0.05, 0.3, -1.1]], [[0, 0, 0], [0.2, 0, 3.0]]])
    code = torch.from_numpy(np.concatenate([motions.reshape(2, 6) / shift, np.ones((2, 4))], 1))
    held = scene.handle_of >= 0
    expected = np.stack([scene.placed_handles(motion)[held] for motion in motions])
    assert_close(handles.positions(code), torch.from_numpy(expected))


def test_harmonic_maps_are_pinned_solves(shape):
    """Of nought and of the identity; at rest nothing moves."""
    handles, code = shape.handles, torch.randn(3, 6, dtype=torch.float64)
    added = handles.rest + torch.einsum("tk,knc->tnc", code, handles.harmonic)
    solver = dp.PoissonSolver(shape.mesh, pins=handles.held)
    frames = shape.mesh.frames.expand(3, -1, -1, -1)
    assert_close(added, solver(frames, pins=handles.positions(code)))
    assert_close(handles.rest, shape.mesh.vertices)


# ------------------------------------------------------- isometries


def test_the_closest_isometry_is_the_closest_rotation():
    generator = torch.Generator().manual_seed(0)
    for c in (2, 3):
        J = torch.randn(50, c, 2, generator=generator, dtype=torch.float64)
        assert_close(closest_isometry(J), dp.closest_rotation(J), rtol=1e-9, atol=1e-9)
        assert_close(closest_isometry(1e-9 * J), dp.closest_rotation(J), rtol=1e-9, atol=1e-9)
    assert gradcheck(closest_isometry, J[:3].requires_grad_())


def test_what_has_collapsed_has_none():
    line = torch.tensor([[1.0, 2], [2, 4], [0, 0]], dtype=torch.float64)
    for J in (line, 0 * line):
        assert_close(closest_isometry(J), 0 * line)


# ------------------------------------------------------- the field


def test_its_map_is_the_pinned_solve_of_its_jacobians(maps, shape):
    """Though only its functions are solved for."""
    code = maps.parameters[:3]
    solver = dp.PoissonSolver(shape.mesh, pins=shape.handles.held)
    for model in (random_model(), random_model(1, relative=True, reads=20)):
        rounds = model.iterates(shape, code)
        assert len(rounds) == 3
        for prediction in rounds:
            R = prediction.jacobians
            expected = solver(R.double(), pins=shape.handles.positions(code))
            assert_close(prediction.vertices, expected.float(), rtol=0, atol=1e-5)
            assert_close(dp.restrict(prediction.matrices, shape.frames), R)
        assert float((rounds[2].vertices - rounds[1].vertices).abs().max()) > 1e-3
        assert_close(model(shape, code[0]).vertices, rounds[2].vertices[0])
        assert_close(model.on(shape)(shape, code).vertices, rounds[2].vertices)
        assert_close(model.with_rounds(2)(shape, code).vertices, rounds[1].vertices)


def test_untrained_it_is_the_harmonic_map(maps, shape):
    prediction = ModalNJF(6, 6, **SIZES)(shape, maps.parameters)
    harmonic = torch.einsum("tk,knc->tnc", maps.parameters.double(), shape.handles.harmonic)
    assert_close(prediction.vertices, (shape.handles.rest + harmonic).float())


def test_it_reads_the_gradient_of_the_energy(shape):
    """By its coefficients, of half the energy that the core has, differentiated by autograd."""
    model = random_model()
    basis = Basis(*(x.double() for x in model.basis(shape)))
    amounts = torch.randn(2, 6, dtype=torch.float64)
    h = (0.2 * torch.randn(2, 8, dtype=torch.float64)).requires_grad_()
    phi = basis.rest + torch.einsum("tk,knc->tnc", amounts, basis.harmonic)
    phi = phi + torch.einsum("tr,rnc->tnc", h, basis.maps)
    energy = dp.arap(dp.jacobians(shape.mesh, phi)) @ shape.face_weights / 2
    (expected,) = torch.autograd.grad(energy.sum(), h)
    assert_close(model.reading(basis, amounts, h), expected, rtol=1e-4, atol=1e-5)


def test_it_reads_nothing_where_the_map_is_as_rigid_as_possible():
    mesh = bumpy_disk(size=8)
    held = (mesh.vertices[:, 0] < -0.6) | (mesh.vertices[:, 0] > 0.6)
    origin = mesh.vertices[held].double()
    nought = origin.new_zeros(1, *origin.shape)
    shape = Shape.prepare(mesh).with_handles(Handles(mesh, held, origin, nought))
    q = origin.clone()
    q[origin[:, 0] < 0] *= 0.8
    found = dp.as_rigid_as_possible(shape.handles.solver, pins=q, tolerance=1e-9, max_steps=20_000)
    torch.manual_seed(0)
    model = ModalNJF(1, 1, **SIZES)
    basis = Basis(*(x.double() for x in model.basis(shape)))
    readings = [
        model.reading(
            basis._replace(read_rest=dp.jacobians(mesh, phi.double())),
            torch.zeros(1, 1, dtype=torch.float64),
            torch.zeros(1, 8, dtype=torch.float64),
        )
        for phi in (found.vertices, found.vertices + 0.1 * basis.maps[0])
    ]
    assert float(readings[0].abs().max()) < 1e-3 * float(readings[1].abs().max())


def test_moved_all_alike_handles_move_the_map_alone(shape, maps):
    model, code = random_model(relative=True), maps.parameters[:2]
    shift = torch.tensor([0.3, -0.2, 0.5])
    one, other = (model(shape, c).vertices for c in (code, code + shift.repeat(2)))
    assert_close(other, one + SETTINGS.reach * shift, rtol=0, atol=1e-5)


def test_without_handles_there_is_no_map(maps, shape):
    free = Shape.prepare(shape.mesh)
    with pytest.raises(ValueError, match=r"see Shape\.with_handles"):
        random_model()(free, maps.parameters)
    known = KnownMaps(maps.parameters, maps.positions)
    with pytest.raises(ValueError, match="needs a shape with handles"):
        fit_modal(random_model(), free, known, known, minutes=0.01)


# ------------------------------------------------------- training


@pytest.fixture(scope="module")
def learned(maps, shape):
    torch.manual_seed(0)
    model = ModalNJF(6, 6, rank=12, width=32, code_width=64)
    known, unseen = (KnownMaps(maps.parameters[x], maps.positions[x]) for x in SPLIT)
    said: list[str] = []
    seconds = fit_modal(model, shape, known, unseen, minutes=0.04, progress=said.append)
    assert 2.4 <= seconds < 5
    assert len(said) == 2
    return model.requires_grad_(False)


def test_the_papers_loss_is_a_distance_of_coefficients(learned, maps, shape):
    """Up to what no coefficients can reach: so training on coefficients has the paper's loss."""
    basis = learned.basis(shape)
    known = KnownMaps(maps.parameters, maps.positions)
    weights = training._Weights.of(shape)
    best = training._best(basis, weights, shape, training._missing(shape.handles, known))
    start = basis.rest + torch.einsum("tk,knc->tnc", maps.parameters, basis.harmonic)
    J = dp.jacobians(shape.mesh, start)

    def loss(h):
        R = J + torch.einsum("tr,rmcd->tmcd", h, basis.fields)
        phi = start + torch.einsum("tr,rnc->tnc", h, basis.maps)
        prediction = Prediction(dp.extend(R, shape.frames), R, phi)
        # Not centred: both maps meet the handles.
        difference = (phi - maps.positions).double().square().sum(-1) @ shape.vertex_weights
        jacobians = paper_loss(shape, prediction, maps.positions).jacobians
        return float(10 * difference.mean() + jacobians)

    off = 0.1 * torch.randn(best.shape, generator=torch.Generator().manual_seed(0))
    expected = float(off.square().sum(-1).mean())
    assert loss(best + off) - loss(best) == pytest.approx(expected, rel=0.02)


def test_it_learns(learned, maps, shape):
    """Maps that are nearer than the harmonic ones, and meet the handles."""
    untrained, _ = evaluate_elastic(ModalNJF(6, 6, **SIZES), maps, shape)
    for rounds in (1, 3):
        records, images = evaluate_elastic(learned.with_rounds(rounds), maps, shape)
        assert summarise(records)["L2-V"] < 0.6 * summarise(untrained)["L2-V"]
        assert_close(images[:, maps.held], maps.positions[:, maps.held], rtol=0, atol=1e-5)


def test_corrections_lead_back(learned, maps, shape):
    """From coefficients that are as far off as first guesses of unseen maps, but otherwise."""
    known, unseen = (KnownMaps(maps.parameters[x], maps.positions[x]) for x in SPLIT)
    weights, basis = training._Weights.of(shape), learned.basis(shape)
    best, held_out = (
        training._best(basis, weights, shape, training._missing(shape.handles, x))
        for x in (known, unseen)
    )
    misses = learned.first_guess(unseen.code) - held_out
    code, best = known.code.repeat(20, 1), best.repeat(20, 1)
    draws = torch.randn(len(code), len(misses), generator=torch.Generator().manual_seed(0))
    off = draws @ misses / len(misses) ** 0.5
    reading = learned.reading(basis, code, best + off)
    after = learned.corrected(code, best + off, reading) - best
    assert float(after.square().sum()) < 0.9 * float(off.square().sum())
    blind = learned.corrected(code, best + off, reading.flip(0)) - best  # what others read
    assert float(after.square().sum()) < 0.9 * float(blind.square().sum())


def test_it_maps_other_triangulations(learned, maps):
    """The first vertices of the refined solid are those of the coarse one."""
    solid = maps.solid
    fine = solid.refined()
    code = maps.parameters[:4]
    coarse = learned(surface(solid), code).vertices
    there = learned.on(shape := surface(fine))(shape, code).vertices
    shared = np.isin(fine.surface, solid.surface)
    assert_close(fine.surface[shared], solid.surface)
    assert float(l2_vertices(there[:, shared], coarse).max()) < 3


def test_a_model_is_kept(tmp_path, maps, shape):
    known = KnownMaps(maps.parameters, maps.positions)
    arguments = {"parameters": 6, "amounts": 6, "rounds": 2, **SIZES}
    first, cost = modal_in(tmp_path / "a", arguments, shape, known, known, minutes=0.01, seed=1)
    again, same = modal_in(tmp_path / "a", arguments, shape, known, known, minutes=9.0, seed=1)
    assert cost == same
    assert cost["cpu seconds"] >= 0.6
    loaded, _ = load_modal(tmp_path / "a" / "model.pt")
    for model in (again, loaded):
        assert torch.equal(
            model(shape, maps.parameters).vertices, first(shape, maps.parameters).vertices
        )


# ------------------------------------------------------- the baseline, pinned


def test_the_global_mlp_is_pinned_too(maps, shape):
    """Its loss does not depend on where in space the targets are, as without pins."""
    torch.manual_seed(0)
    model = GlobalMLP(shape.mesh.n_faces, 6, width=16)
    torch.nn.init.normal_(model.layers[-1].weight, std=0.05)
    model.requires_grad_(False)
    prediction = model(shape, maps.parameters[:3])
    assert_close(prediction.vertices[:, maps.held], maps.positions[:3, maps.held])
    expected = shape.handles.solver(
        prediction.jacobians, pins=shape.handles.positions(maps.parameters[:3])
    )
    assert_close(prediction.vertices, expected)
    here, there = (
        paper_loss(shape, prediction, maps.positions[:3] + shift).vertices for shift in (0.0, 5.0)
    )
    assert_close(here, there, rtol=1e-3, atol=1e-6)


def test_mean_and_spread():
    rows = [{"a": 1.0, "b": 2.0}, {"a": 4.0, "b": 2.0}, {"a": 1.0, "b": 2.0}]
    assert mean(rows) == {"a": 2, "b": 2}
    assert spread(rows) == {"a": 3, "b": 0}
