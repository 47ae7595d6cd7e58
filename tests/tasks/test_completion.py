"""Shape completion's loss against values worked out by hand, with a renderer whose answer is known."""

from dataclasses import dataclass, field, replace
from math import sqrt

import numpy as np
import pytest
import torch

from bench.config import load
from bench.shape_prior import Prior
from bench.solve.latent_code import CodePenalty
from bench.solve.optimise import History, OptimiserSettings, optimise
from bench.tasks.completion import Completion
from datasets.scene import Scene, View
from renderers.camera import Camera
from renderers.field import Kind
from renderers.fields.mlp import Decoder
from renderers.fields.textured import TexturedDecoder
from renderers.rendering import Capabilities, Rendering, Status
from renderers.silhouette import Own
from tests.looped import each
from tests.tiny import CPU, TRIANGLE

SETTINGS = Completion(
    points="dense",
    depths="measured",
    mask=True,
    depth_loss="depth",
    depth_weight=10.0,
    normal_weight=0.0,
    normal_width=0.02,
    colour_weight=0.0,
    silhouette=Own(),
    silhouette_weight=4.0,
    code=CodePenalty(0.1, "sum"),
    similarity=False,
    rotations=2,
    trial=3,
    optimiser=OptimiserSettings(20, 0.01, "constant"),
)
# An image of 2 x 2 pixels with a focal length of 1 pixel: all bearings are (+-0.5, +-0.5, 1).
COSINE = 1 / sqrt(1.5)
MASK = [[True, True], [True, False]]
DEPTH = [[2.0, 2.0], [2.0, 0.0]]
DISTANCE = [[2.1 / COSINE, 1.7 / COSINE], [9.0, 9.0]]  # depth errors 0.1 and 0.3 where it is compared
STATUS = ((Status.HIT, Status.HIT), (Status.OUT_OF_STEPS, Status.HIT))
CAN = Capabilities((Kind.DISTANCE,), field_gradient=True, ray_gradient=False)
SILHOUETTE = 0.7


@dataclass
class Fake:
    """Gives a known rendering, whose distances carry the gradient of one value of the field a ray."""

    status: tuple = STATUS
    capabilities: Capabilities = CAN
    asked: torch.Tensor | None = None

    def render(self, field, rays):
        values = field(rays.at(torch.ones(rays.shape)))
        distance = torch.tensor(DISTANCE) + (values - values.detach())
        status = torch.tensor(self.status, dtype=torch.int8)
        return Rendering(distance, status, rays.at(distance), torch.zeros(rays.shape), values)

    def silhouette_loss(self, field, rays, rendering, mask):
        self.asked = mask
        return rendering.closest.sum() * 0 + SILHOUETTE


@pytest.fixture(scope="module")
def scene() -> Scene:
    motion = torch.tensor([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2.5], [0, 0, 0, 1]])
    camera = Camera(torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 1]]), motion, height=2, width=2)
    normals = torch.tensor([[[0.0, 0.6, 0.8], [0.6, 0.0, 0.8]], [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]])
    return Scene("a scene", TRIANGLE, View(camera, torch.tensor(DEPTH), normals, torch.tensor(MASK)))


@pytest.fixture(scope="module")
def prior() -> Prior:
    torch.manual_seed(0)
    return Prior(Decoder(layers=2, width=16, code_length=4, skip=1, narrow=False), torch.zeros(1, 4))


@pytest.fixture
def problem_of(scene, prior):
    def make(renderer=None, **changed):
        return replace(SETTINGS, **changed).problem(scene, prior, renderer or Fake(), seed=0, device=CPU)

    return make


def values(problem) -> dict[str, float]:
    return {name: term.item() for name, term in problem.loss(0).items()}


def test_depth_is_compared_where_it_is_given_and_hit(problem_of):
    """Depths differ by .1 and .3 where they are compared; along the rays that is 1 / COSINE as much."""
    terms = values(problem_of())
    assert terms["depth"] == pytest.approx(10.0 * (0.1 + 0.3) / 2, rel=1e-5)
    assert terms["code"] == 0.0
    assert terms["silhouette"] == pytest.approx(4.0 * SILHOUETTE)
    assert terms["total"] == pytest.approx(2.0 + 2.8, rel=1e-5)
    assert values(problem_of(depth_loss="points"))["depth"] == pytest.approx(10.0 * 0.2 / COSINE)
    few = problem_of(points="1")
    assert few.observed.sum() == 1
    expected = {(0, 0): 0.1, (0, 1): 0.3, (1, 0): 0.0}[tuple(few.observed.nonzero()[0].tolist())]
    assert values(few)["depth"] == pytest.approx(10.0 * expected, rel=1e-4)


def test_normals_are_compared_where_they_are_asked_for(problem_of, scene):
    """See tests/solve/test_observed_view.py for the term itself."""
    assert problem_of().compare.func.__self__.normals is None
    problem = problem_of(normal_weight=3.0)
    terms, view = values(problem), problem.compare.func.__self__
    assert (view.normal_weight, view.normal_width) == (3.0, 0.02) and torch.equal(view.normals, scene.view.normals)
    assert terms["total"] == pytest.approx(sum(terms[name] for name in terms if name != "total"))


def test_colours_are_compared_where_the_shape_is_shown_and_hit(problem_of, scene):
    """Of the three pixels that show the shape two are hit; the gradient reaches both halves of the code."""
    torch.manual_seed(0)
    textured = Prior(TexturedDecoder(layers=2, width=16, code_length=4, skip=1, narrow=False), torch.zeros(1, 4))
    red = replace(scene, texture=lambda points, normals: np.tile([0.9, 0.2, 0.2], (len(points), 1)))
    problem = replace(SETTINGS, colour_weight=3.0).problem(red, textured, Fake(), seed=0, device=CPU)
    terms = problem.loss(0)
    painted = problem.field().paint(red.view.camera.rays().at(torch.tensor(DISTANCE))[0])
    assert terms["colour"].item() == pytest.approx(3 * (painted - torch.tensor([0.9, 0.2, 0.2])).abs().mean().item())
    terms["colour"].backward()
    assert (problem.code.grad[:2] != 0).any() and (problem.code.grad[2:] != 0).all()


def test_no_pixel_to_compare_costs_nothing(problem_of):
    problem = problem_of(Fake(status=((Status.MISS,) * 2,) * 2))
    terms = problem.loss(0)
    assert terms["depth"].item() == 0.0
    terms["total"].backward()
    assert problem.code.grad.isfinite().all()


@each("average, expected", [("sum", 0.3), ("mean", 0.075)])
def test_the_code_is_held_short(problem_of, average, expected):
    problem = problem_of(code=CodePenalty(0.1, average))
    problem.code.data = torch.tensor([1.0, -1.0, 0.0, 1.0])
    terms = values(problem)
    assert terms["code"] == pytest.approx(expected)
    assert terms["total"] == pytest.approx(terms["depth"] + terms["silhouette"] + expected)


@dataclass
class TakesDistances(Fake):
    """A fake whose loss takes the given distances as well."""

    def observed_loss(self, field, rays, rendering, observed):
        self.asked = observed.distance
        return rendering.closest.sum() * 0 + SILHOUETTE


def test_the_mask_is_compared_where_it_is_given_by_the_loss_that_is_chosen(problem_of):
    sparse, dense, other, taking = Fake(), Fake(), Fake(), TakesDistances()
    assert set(values(problem_of(sparse, points="3", mask=False))) == {"total", "depth", "code"}
    assert sparse.asked is None
    assert "silhouette" in values(problem_of(dense, points="dense", mask=False))  # which implies it
    assert dense.asked.tolist() == MASK
    chosen = values(problem_of(other, silhouette=load("silhouette", "hinge")))
    assert other.asked is None and chosen["silhouette"] != pytest.approx(4.0 * SILHOUETTE)
    problem = problem_of(taking, points="2")
    values(problem)
    taken = taking.asked.isfinite()
    assert torch.equal(taken, problem.observed) and taken.sum() == 2
    assert taking.asked[taken].tolist() == pytest.approx([2.0 / COSINE] * 2)


def test_the_gradient_is_that_of_the_loss(problem_of, prior, scene):
    """d depth / d code = weight / 2 * cosine * sum of sign(error) * d field / d code over the two pixels."""
    problem = problem_of(silhouette_weight=0.0)
    problem.loss(0)["total"].backward()
    code = torch.zeros(4, requires_grad=True)
    field = prior.decoder.at(code)(scene.view.camera.rays().at(torch.ones(2, 2)))
    (expected,) = torch.autograd.grad(field[0, 0] - field[0, 1], code)
    assert torch.allclose(problem.code.grad, 10.0 / 2 * COSINE * expected, rtol=1e-4, atol=1e-6)


def test_evaluations_are_counted_and_judging_is_not(problem_of):
    problem = problem_of()
    assert problem.rays_per_iteration == 4
    problem.loss(0)["total"].backward()
    assert (problem.counts.value, problem.counts.gradient) == (4, 2)  # two pixels are compared
    field = problem.field()
    assert not field(torch.zeros(5, 3)).requires_grad
    assert problem.counts.value == 4


@dataclass
class Scheduled(Fake):
    """A renderer with a schedule: what was asked of it, and at which iteration."""

    iteration_asked: int | None = None
    log: list = field(default_factory=list)

    def at_iteration(self, iteration):
        return replace(self, iteration_asked=iteration)

    def render(self, field, rays):
        self.log.append(("render", self.iteration_asked))
        return super().render(field, rays)

    def silhouette_loss(self, field, rays, rendering, mask):
        self.log.append(("silhouette", self.iteration_asked))
        return super().silhouette_loss(field, rays, rendering, mask)


def test_a_renderer_with_a_schedule_is_as_it_is_at_the_iteration(problem_of):
    renderer = Scheduled()
    problem = problem_of(renderer)
    problem.loss(7)
    assert renderer.log == [("render", 7), ("silhouette", 7)]
    renderer.log.clear()
    assert renderer.iteration_asked is None  # what is judged and drawn is by the renderer as configured
    optimise(problem, OptimiserSettings(3, 0.01, "constant"), CPU, history=History(), on_step=lambda line: None)
    assert [iteration for what, iteration in renderer.log if what == "render"] == [0, 0, 1, 2]  # the warm-up first


class Single(Fake):
    """A renderer of rays in one row; it notes their directions and the mask that it compares with."""

    def render(self, field, rays):
        self.directions = rays.directions
        closest = field(rays.at(torch.ones(rays.shape)))
        status = torch.full(rays.shape, Status.MISS, dtype=torch.int8)
        return Rendering(
            torch.ones(rays.shape), status, rays.at(torch.ones(rays.shape)), torch.zeros(rays.shape), closest
        )


def test_a_pixel_of_each_block_is_compared(scene, problem_of):
    """Another one in each iteration, with its own observations."""
    renderer = Single()
    problem, rays, seen = problem_of(renderer, pixel_block=2), scene.view.camera.rays().flat(), set()
    assert problem.rays_per_iteration == 1
    for iteration in range(20):
        problem.loss(iteration)
        (pixel,) = (rays.directions == renderer.directions).all(-1).nonzero().squeeze(-1).tolist()
        assert renderer.asked.tolist() == [scene.view.mask.flatten()[pixel].item()]
        seen.add(pixel)
    assert seen == {0, 1, 2, 3}
    problem.objective()
    assert torch.equal(renderer.directions, rays.directions.view(2, 2, 3)) and problem_of(renderer).objective() is None
