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
from bench.solve.solve import Unsupported, check_kind
from bench.tasks.completion import Completion
from datasets.mesh import Mesh
from datasets.scene import Scene, View
from renderers.camera import Camera
from renderers.field import Kind
from renderers.fields.mlp import Decoder
from renderers.rendering import Capabilities, Rendering, Status
from renderers.silhouette import Own
from tests.looped import each

CPU = torch.device("cpu")
SETTINGS = Completion(
    points="dense",
    depths="measured",
    mask=True,
    depth_loss="depth",
    depth_weight=10.0,
    normal_weight=0.0,
    normal_width=0.02,
    silhouette=Own(),
    silhouette_weight=4.0,
    code=CodePenalty(0.1, "sum"),
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
    mesh = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 2, 1]]))
    normals = torch.tensor([[[0.0, 0.6, 0.8], [0.6, 0.0, 0.8]], [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]])
    return Scene("a scene", mesh, View(camera, torch.tensor(DEPTH), normals, torch.tensor(MASK)))


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
    terms = values(problem_of())
    assert terms["depth"] == pytest.approx(10.0 * (0.1 + 0.3) / 2, rel=1e-5)
    assert terms["code"] == 0.0
    assert terms["silhouette"] == pytest.approx(4.0 * SILHOUETTE)
    assert terms["total"] == pytest.approx(2.0 + 2.8, rel=1e-5)


def test_depth_is_compared_at_the_given_points_only(problem_of):
    problem = problem_of(points="1")
    assert problem.observed.sum() == 1
    expected = {(0, 0): 0.1, (0, 1): 0.3, (1, 0): 0.0}[tuple(problem.observed.nonzero()[0].tolist())]
    assert values(problem)["depth"] == pytest.approx(10.0 * expected, rel=1e-4)


def test_normals_are_compared_where_they_are_asked_for(problem_of, scene):
    """See tests/solve/test_observed_view.py for the term itself."""
    assert "normals" not in values(problem_of())
    assert problem_of().compare.__self__.normals is None
    problem = problem_of(normal_weight=3.0)
    assert 0 <= values(problem)["normals"] <= 2 * 3.0
    given = problem.compare.__self__
    assert (given.normal_weight, given.normal_width) == (3.0, 0.02) and torch.equal(given.normals, scene.view.normals)
    terms = problem.loss(0)
    assert terms["total"].item() == pytest.approx(sum(terms[name].item() for name in terms if name != "total"))


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
class Told(Fake):
    """A fake whose loss takes the given distances as well."""

    def observed_loss(self, field, rays, rendering, observed):
        self.asked = observed.distance
        return rendering.closest.sum() * 0 + SILHOUETTE


def test_given_distances_are_told_to_a_loss_that_takes_them(problem_of):
    renderer = Told()
    problem = problem_of(renderer, points="2")
    values(problem)
    given = renderer.asked.isfinite()
    assert torch.equal(given, problem.observed) and given.sum() == 2
    assert renderer.asked[given].tolist() == pytest.approx([2.0 / COSINE] * 2)


def test_without_a_mask_there_is_no_silhouette_term(problem_of):
    renderer = Fake()
    terms = values(problem_of(renderer, points="3", mask=False))
    assert set(terms) == {"total", "depth", "code"}
    assert renderer.asked is None
    assert terms["total"] == terms["depth"]


def test_dense_depth_implies_the_mask(problem_of):
    renderer = Fake()
    assert "silhouette" in values(problem_of(renderer, points="dense", mask=False))
    assert renderer.asked.tolist() == MASK


def test_the_gradient_is_that_of_the_loss(problem_of, prior, scene):
    """d depth / d code = weight / 2 * cosine * sum of sign(error) * d field / d code over the two pixels."""
    problem = problem_of(silhouette_weight=0.0)
    problem.loss(0)["total"].backward()
    code = torch.zeros(4, requires_grad=True)
    field = prior.decoder.at(code)(scene.view.camera.rays().at(torch.ones(2, 2)))
    (expected,) = torch.autograd.grad(field[0, 0] - field[0, 1], code)
    assert torch.allclose(problem.code.grad, 10.0 / 2 * COSINE * expected, rtol=1e-4, atol=1e-6)


def test_the_depth_loss_is_of_depths_or_of_points(problem_of):
    """Depths differ by .1 and .3 where they are compared; along the rays that is 1 / COSINE as much."""
    assert problem_of().loss(0)["depth"].item() == pytest.approx(10.0 * 0.2)
    assert problem_of(depth_loss="points").loss(0)["depth"].item() == pytest.approx(10.0 * 0.2 / COSINE)


def test_the_mask_loss_is_the_one_that_is_chosen(problem_of):
    renderer = Fake()
    terms = problem_of(renderer, silhouette=load("silhouette", "hinge")).loss(0)
    assert renderer.asked is None
    assert terms["silhouette"].item() != pytest.approx(4.0 * SILHOUETTE)


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

    at: int | None = None
    log: list = field(default_factory=list)

    def at_iteration(self, iteration):
        return replace(self, at=iteration)

    def render(self, field, rays):
        self.log.append(("render", self.at))
        return super().render(field, rays)

    def silhouette_loss(self, field, rays, rendering, mask):
        self.log.append(("silhouette", self.at))
        return super().silhouette_loss(field, rays, rendering, mask)


def test_a_renderer_with_a_schedule_is_as_it_is_at_the_iteration(problem_of):
    renderer = Scheduled()
    problem = problem_of(renderer)
    problem.loss(7)
    assert renderer.log == [("render", 7), ("silhouette", 7)]
    renderer.log.clear()
    assert renderer.at is None  # what is judged and drawn is by the renderer as configured
    optimise(problem, OptimiserSettings(3, 0.01, "constant"), CPU, history=History(), on_step=lambda line: None)
    assert [at for what, at in renderer.log if what == "render"] == [0, 0, 1, 2]  # the first is the warm-up


def test_a_renderer_without_a_gradient_towards_the_field_is_unsupported(problem_of):
    blind = Fake(capabilities=Capabilities((Kind.DISTANCE,), field_gradient=False, ray_gradient=True))
    with pytest.raises(Unsupported, match="Fake has no gradient towards the field"):
        problem_of(blind)


@each("needs, names", [((Kind.LEVEL,), "level"), ((Kind.BOUND, Kind.LEVEL), "bound or level")])
def test_a_renderer_that_needs_another_kind_of_field_is_unsupported(problem_of, needs, names):
    picky = Fake(capabilities=Capabilities(needs, field_gradient=True, ray_gradient=True))
    field = problem_of().field()
    with pytest.raises(Unsupported, match=f"Fake needs a {names} field, not a distance field"):
        check_kind(picky, field)
    check_kind(Fake(), field)
