"""The optimisation loop on problems with a known solution."""

from copy import deepcopy
from dataclasses import dataclass, field, replace
from math import isnan
from typing import Any

import pytest
import torch

from bench.config import load
from bench.records.record import RunStatus
from bench.solve.optimise import (
    BUDGET,
    DIVERGENCE_FACTOR,
    CannotContinue,
    History,
    OptimiserSettings,
    Starts,
    StartSettings,
    optimise,
    with_affordable_rays,
)
from renderers.boundary import render_checked
from renderers.checks import BrokenContract
from renderers.field import Counts, Meter
from renderers.fields.analytic import sphere
from renderers.rendering import at_iteration
from renderers.schedule import Iteration, schedule_position
from tests.looped import each
from tests.operations import Operations
from tests.tiny import camera_of
from tests.wrong_hits import WrongHits

CPU = torch.device("cpu")
POINTS = 7  # field evaluations of the loss of a toy
RAYS = camera_of(16).rays()


@dataclass
class Toy:
    """A problem with a radius as its parameter. Its solution is 3, where the field at a fixed point is zero.

    `spoil` maps the number of a call to a factor of its loss. Call 0 is the warm-up.
    """

    spoil: dict[int, float] = field(default_factory=dict)
    counts: Counts = field(default_factory=Counts)
    calls: int = 0
    rays_per_iteration: int = POINTS

    def __post_init__(self):
        self.radius = torch.tensor(1.0, requires_grad=True)
        self.parameters = [self.radius]

    def loss(self, iteration):
        metered = Meter(sphere(self.radius), self.counts)
        values = metered(torch.tensor([3.0, 0, 0]).expand(POINTS, 3))
        square = values.square().mean() * self.spoil.get(self.calls, 1.0)
        self.calls += 1
        return {"total": square, "square": square}


def go(problem, iterations=10, *, rate=0.05, on_step=lambda line: None, notes=None) -> History:
    history = History(notes=notes)
    optimise(problem, OptimiserSettings(iterations, rate, "constant"), CPU, history=history, on_step=on_step)
    return history


@dataclass
class TwoParameters(Toy):
    """Two parameters. The second one has no gradient in each second iteration."""

    def __post_init__(self):
        super().__post_init__()
        self.offset = torch.tensor([0.5, -0.5], requires_grad=True)
        self.parameters = [self.radius, self.offset]

    def loss(self, iteration):
        terms = super().loss(iteration)
        return terms if iteration % 2 else {"total": terms["total"] + (self.offset**4).sum()}


def test_a_step_equals_that_of_adam_in_torch():
    ours, theirs = TwoParameters(), TwoParameters()
    settings = OptimiserSettings(20, 0.1, "cosine")
    optimise(ours, settings, CPU, history=History(), on_step=lambda line: None)
    adam = torch.optim.Adam(theirs.parameters)
    for iteration in range(20):
        adam.param_groups[0]["lr"] = settings.rate(iteration)
        adam.zero_grad()
        theirs.loss(iteration)["total"].backward()
        adam.step()
    assert all(
        torch.equal(actual, expected) for actual, expected in zip(ours.parameters, theirs.parameters, strict=True)
    )


def test_the_warm_up_is_neither_counted_nor_part_of_the_first_step():
    toy, gradients = Toy(), []
    history = go(toy, 4, on_step=lambda line: gradients.append(toy.radius.grad.item()))
    assert toy.calls == 5 and (history.counts.value, history.counts.gradient) == (4 * POINTS, 4 * POINTS)
    assert [line["value_evaluations"] for line in history.curve] == [POINTS * n for n in (1, 2, 3, 4)]
    assert [line["gradient_evaluations"] for line in history.curve] == [POINTS * n for n in (1, 2, 3, 4)]
    assert history.seconds["warmup"] > 0
    assert gradients[0] == pytest.approx(-4.0)  # d/dr (3 - r)^2 at 1, not twice that


def test_terms_are_read_in_one_wait_and_gradients_in_another():
    class Many(Toy):
        def __post_init__(self):
            super().__post_init__()
            self.parameters = [self.radius, *(torch.zeros(2, requires_grad=True) for _ in range(6))]

        def loss(self, iteration):
            terms = {f"term {number}": term.square().mean() for number, term in enumerate(self.parameters)}
            return {"total": torch.stack(list(terms.values())).sum(), **terms}

    problem = Many()
    with Operations() as counted:
        history = go(problem, 3)
    steps = 3 * len(problem.parameters)  # Adam has a counter per parameter, which is always on the CPU
    assert counted.waits == {"_local_scalar_dense": steps}
    assert history.curve[0]["total"] == history.curve[0]["term 0"] == 1.0


def test_the_time_of_on_step_is_not_counted(clock):
    class Slow(Toy):
        def loss(self, iteration):
            clock.sleep(1.0)
            return super().loss(iteration)

    history = go(Slow(), 3, on_step=lambda line: clock.sleep(100.0))
    assert history.seconds == pytest.approx({"warmup": 1.0, "forward": 3.0, "backward": 0.0}, abs=0.01)


@each("nan_terms, subject", [
    ((), "the loss is"), (("depth",), "the depth term is"), (("depth", "mask"), "the depth and the mask terms are"),
])  # fmt: skip
def test_a_loss_that_is_nan_names_its_terms_and_no_step_is_taken(nan_terms, subject):
    class Spoilt(Toy):
        def loss(self, iteration):
            terms = {name: self.radius.square() for name in ("depth", "code", "mask")}
            if iteration == 2:
                terms |= {name: term * torch.nan for name, term in terms.items() if name in nan_terms}
                return {"total": self.radius * torch.nan, **terms}
            return {"total": torch.stack(list(terms.values())).sum(), **terms}

    toy, radii = Spoilt(), []
    history = go(toy, on_step=lambda line: radii.append(toy.radius.item()))
    assert (history.status, history.reason) == (RunStatus.NAN, f"{subject} not a number at iteration 2")
    assert radii[0] > radii[1] == radii[2] == toy.radius.item()
    assert [line["iteration"] for line in history.curve] == [0, 1, 2] and isnan(history.curve[-1]["total"])


@dataclass
class RenderedSphere(Toy):
    """The radius of a sphere, fitted to the mean distance of rendered hits."""

    renderer: Any = None

    def loss(self, iteration):
        shape = sphere(self.radius / 2)
        rendering = render_checked(self.renderer, Meter(shape, self.counts), RAYS)
        self.calls += 1
        depth = ((rendering.distance - 1.8).square() * rendering.hit).sum() / rendering.hit.sum().clamp_min(1)
        return {"total": depth, "depth": depth}


def test_a_loss_that_is_nan_states_how_many_hits_have_no_distance():
    problem = RenderedSphere(renderer=WrongHits("endless"))
    history = go(problem)
    assert history.status is RunStatus.NAN and problem.radius.item() == 1.0
    assert history.reason.startswith("the depth term is not a number at iteration 0: 11 of 256 rays have a hit without")
    assert history.reason.endswith("(the field is finite on them, so the renderer is at fault)")


def checked(how: str, problem: type[RenderedSphere] = RenderedSphere) -> tuple[RenderedSphere, History, list[str]]:
    """Runs a loop that checks the hits of its first loss; gives the problem, the history and the notes."""
    notes: list[str] = []
    instance = problem(renderer=WrongHits(how) if how else load("renderer", "dist"))
    return instance, go(instance, 3, notes=notes), notes


def test_the_first_hits_are_checked_once_and_neither_counted_nor_changed():
    problem, history, notes = checked("")
    plain = RenderedSphere(renderer=problem.renderer)
    alone = go(plain, 3)
    assert notes == [] and history.counts == alone.counts and history.counts.value > 0
    assert [line["total"] for line in history.curve] == [line["total"] for line in alone.curve]
    assert problem.radius.item() == plain.radius.item() and problem.calls == 4


def test_hits_off_the_surface_are_noted_once_and_the_loop_goes_on():
    _, history, notes = checked("short")
    assert history.status is RunStatus.OK and len(history.curve) == 3
    (note,) = notes
    assert note.startswith("at the first iteration, WrongHits.render: ") and "not on the surface" in note


def test_hits_that_break_the_contract_end_the_loop_except_if_the_loss_is_nan():
    class Blind(RenderedSphere):
        """A problem whose loss does not depend on the distances."""

        def loss(self, iteration):
            super().loss(iteration)
            return {"total": self.radius.square()}

    with pytest.raises(BrokenContract, match="hits have a negative distance"):
        checked("behind")
    with pytest.raises(BrokenContract, match="11 of 256 rays have a hit without a finite distance"):
        checked("endless", Blind)
    _, history, notes = checked("endless")
    assert (history.status, notes) == (RunStatus.NAN, [])


def test_a_gradient_that_is_not_finite_ends_the_loop_before_its_step():
    class Cornered(Toy):
        def loss(self, iteration):
            self.calls += 1
            return {"total": (self.radius - 1.0).abs().sqrt()}  # 0 with an infinite slope at the start

    toy = Cornered()
    history = go(toy)
    assert (history.status, history.reason) == (RunStatus.NAN, "the gradient is not finite at iteration 0")
    assert len(history.curve) == 1 and toy.radius.item() == 1.0


@each("factor, diverges", [(0.99 * DIVERGENCE_FACTOR, False), (1.2 * DIVERGENCE_FACTOR, True), (1e20, True)])
def test_a_loss_far_above_its_first_value_has_diverged(factor, diverges):
    history = go(Toy(spoil={3: factor}), 5, rate=1e-4)
    assert history.status is (RunStatus.DIVERGED if diverges else RunStatus.OK)
    assert len(history.curve) == (3 if diverges else 5)
    if diverges:
        assert "the loss rose from 4 to" in history.reason and "by iteration 2" in history.reason


def test_the_history_is_complete_if_the_loop_is_interrupted():
    def stop(line):
        if line["iteration"] == 2:
            raise KeyboardInterrupt

    history = History()
    with pytest.raises(KeyboardInterrupt):
        optimise(Toy(), OptimiserSettings(10, 0.1, "constant"), CPU, history=history, on_step=stop)
    assert [line["iteration"] for line in history.curve] == [0, 1, 2] and history.counts.value == 3 * POINTS
    assert history.seconds["forward"] > 0


def test_a_cosine_falls_from_the_rate_to_nearly_zero():
    rates = [OptimiserSettings(10, 0.2, "cosine").rate(iteration) for iteration in range(10)]
    assert rates[0] == 0.2 and rates[5] == pytest.approx(0.1)
    assert rates == sorted(rates, reverse=True) and 0 < rates[-1] < 0.01
    assert {OptimiserSettings(10, 0.2, "constant").rate(iteration) for iteration in range(10)} == {0.2}
    steps = [OptimiserSettings(10, 0.2, "steps").rate(iteration) for iteration in range(10)]
    assert steps == pytest.approx([0.2] * 6 + [0.04] * 2 + [0.008] * 2)
    ramped, cosine = ([OptimiserSettings(40, 0.2, name).rate(i) for i in range(40)] for name in ("ramped", "cosine"))
    assert ramped[:4] == pytest.approx([0.05, 0.09985, 0.14908, 0.19724], abs=1e-5) and ramped[4:] == cosine[4:]


def play(count: int, trial: int, iterations: int, loss) -> list[tuple[int, int]]:
    starts = Starts(StartSettings(count, trial))
    turns = []
    for iteration in range(iterations):
        start, step = starts.assignment(iteration)
        starts.note(float(loss(start, step)))
        turns.append((start, step))
    return turns


def test_starts_take_turns_and_the_best_start_continues_by_the_end_of_its_round():
    turns = play(3, 2, 9, lambda start, step: (5.0, 1.0, 3.0)[start])
    assert turns == [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1), (1, 2), (1, 3), (1, 4)]
    assert play(2, 6, 20, lambda start, step: 100 - 30 * step if start else 10)[-1] == (1, 6 + 20 - 12 - 1)


def test_a_quarter_of_the_starts_remains_after_each_round():
    assert StartSettings(48, 4).rounds == [48, 12, 3] and StartSettings(48, 4).trials == 4 * 63
    assert StartSettings(1, 8).rounds == [] and StartSettings(5, 1).rounds == [5, 2]
    turns = play(5, 1, 10, lambda start, step: 10 - start if step == 0 else 100 * start)
    assert [start for start, _ in turns] == [0, 1, 2, 3, 4, 4, 3, 3, 3, 3]  # 4 and 3 remain, and then 3 is better
    assert [step for _, step in turns[5:]] == [1, 1, 2, 3, 4]


def test_the_first_start_is_best_until_all_were_tried():
    starts = Starts(StartSettings(2, 1))
    starts.assignment(1)
    starts.note(0.0)
    assert starts.best() == 0


class OneBadStart(Toy):
    """Two starts; from a step on, the first one has a loss or a gradient that is NaN, a large loss, or no pixel."""

    def __init__(self, bad: str, since: int = 0):
        super().__init__()
        self.since = since
        self.bad, self.starts = bad, Starts(StartSettings(2, 2))
        self.radii = [torch.tensor(1.0, requires_grad=True) for _ in range(2)]
        self.parameters = self.radii

    def loss(self, step, start):
        self.radius = self.radii[start]
        total = super().loss(step)["total"]
        if start == 0 and self.bad and step >= self.since:
            if self.bad == "blind" and self.starts.is_alone:
                raise CannotContinue("no pixel is left")
            infinite_slope = (self.radius - self.radius.detach()).abs().sqrt()
            total = total + {"gradient": 0.0 * infinite_slope, "large": 1e6}.get(self.bad, torch.nan)
        return {"total": total}


@pytest.mark.parametrize("since", [0, 1])  # 1 is the last step of the round
@pytest.mark.parametrize("bad", ["loss", "gradient", "large", "blind"])
def test_other_starts_go_on_if_a_start_fails(bad, since):
    problem = OneBadStart(bad, since)
    history = go(problem, 8)
    assert (history.status, len(history.curve), problem.starts.best()) == (RunStatus.OK, 8, 1)
    assert problem.radii[1].item() > 1.2
    assert (problem.radii[0].item() == 1.0) == (bad != "large" and since == 0)
    assert history.first_loss == pytest.approx(4.0) == problem.starts.first_loss(1)  # of the start that remains


def test_a_run_ends_with_nan_if_all_starts_are_nan():
    problem = OneBadStart("")
    problem.spoil = dict.fromkeys(range(20), torch.nan)
    history = go(problem, 8)
    assert (history.status, len(history.curve)) == (RunStatus.NAN, 5)  # two rounds of two starts, then the last start


def test_rounds_must_leave_something_of_the_budget():
    StartSettings(4, 8).check(OptimiserSettings(33, 0.1, "constant"))
    with pytest.raises(ValueError, match=r"optimiser\.iterations must be more than 32, not 32: 4 starts share it"):
        StartSettings(4, 8).check(OptimiserSettings(32, 0.1, "constant"))
    StartSettings(1, 8).check(OptimiserSettings(1, 0.1, "constant"))


def test_the_step_that_reaches_the_budget_is_the_last_one():
    assert Counts(value=10, gradient=3, coarse=16).cost == 10 + 2 * 3 + 16 / 8
    toy, history = Toy(), History()
    settings = OptimiserSettings(10, 0.05, "constant", budget=2.5 * 3 * POINTS)  # a value and a gradient count as 3
    optimise(toy, settings, CPU, history=history, on_step=lambda line: None)
    assert [line["cost"] for line in history.curve] == [3 * POINTS * n for n in (1, 2, 3)]
    assert history.status is RunStatus.OK
    with pytest.raises(ValueError, match="budget"):
        replace(settings, budget=0.0)


class Changing(Toy):
    """A toy whose iterations cost four times as much from the fifth on; it notes the iterations that it is given."""

    def __post_init__(self):
        super().__post_init__()
        self.iterations = []

    def loss(self, iteration):
        self.iterations.append(iteration)
        terms = super().loss(iteration)
        for _ in range(3 * (iteration >= 5)):
            Meter(sphere(self.radius.detach()), self.counts)(torch.zeros(POINTS, 3))
        return terms


def spend(problem, budget: float, *, iterations: int = 100) -> History:
    """Ends at a budget in multiples of `POINTS`; an iteration costs three, for a value and a gradient."""
    history, settings = History(), OptimiserSettings(iterations, 0.05, "cosine", budget * POINTS, BUDGET)
    optimise(problem, settings, CPU, history=history, on_step=lambda line: None)
    return history


def test_a_loop_that_its_budget_ends_follows_its_schedules_by_what_is_spent():
    toy = Changing()
    history = spend(toy, 100)
    assert history.status is RunStatus.OK
    costs = [line["cost"] / POINTS for line in history.curve]
    assert costs[:6] == [3, 6, 9, 12, 15, 21] and costs[-2] < 100 <= costs[-1]
    given = toy.iterations[1:]  # without the warm-up
    assert [int(iteration) for iteration in given] == list(range(len(costs)))
    assert [schedule_position(iteration) for iteration in given] == [int(cost) for cost in (0, *costs[:-1])]
    rates = OptimiserSettings(100, 0.05, "cosine")
    assert rates.rate(given[6]) == rates.rate(int(costs[5])) != rates.rate(6)


@each("budget, reason", [(29, "paid for 8 iterations, fewer than 10"), (40, "")])
def test_a_budget_that_pays_for_few_iterations_has_no_result(budget, reason):
    history = spend(Changing(), budget)
    assert (history.status is RunStatus.NOT_REACHED) == bool(reason) and reason in history.reason


@each("since, iterations", [(0, 11), (5, 15)])
def test_a_budget_of_which_nothing_is_spent_any_more_ends_the_loop(since, iterations):
    class Free(Toy):
        def loss(self, iteration):
            return {"total": self.radius**2} if iteration >= since else super().loss(iteration)

    history = spend(Free(), 1e4)
    assert (history.status, len(history.curve)) == (RunStatus.NOT_REACHED, iterations)
    assert "evaluated no field" in history.reason


def test_an_iteration_keeps_its_position_in_a_copy():
    iteration = deepcopy(Iteration(7, 3))
    assert (iteration, schedule_position(iteration), schedule_position(7)) == (7, 3, 7)


@each("name", ["neus", "opaque", "volsdf", "unisurf", "dvr"])
def test_schedules_follow_the_position_and_a_memory_the_index(name):
    renderer = load("renderer", name)
    assert at_iteration(renderer, Iteration(500, 0)) == at_iteration(renderer, 0) != at_iteration(renderer, 90)
    newton = load("renderer", "newton")
    newton.memory.audited = 5
    at_iteration(newton, Iteration(3, 0))
    assert newton.memory.audited == 5


def test_a_loop_that_its_budget_ends_needs_a_budget_and_a_single_start():
    with pytest.raises(ValueError, match=r"task\.optimiser\.budget"):
        OptimiserSettings(10, 0.1, "constant", ends=BUDGET)
    with pytest.raises(ValueError, match=r"task\.optimiser\.ends=iterations"):
        StartSettings(4, 8).check(OptimiserSettings(100, 0.1, "constant", 1e5, BUDGET))


@dataclass(frozen=True)
class Sampled:
    """A task whose iteration costs `POINTS` times 256 over the pixels of a block."""

    optimiser: OptimiserSettings
    pixel_block: int = 0


@each("budget, block", [(None, 1), (40 * 256, 1), (40 * 256 - 1, 2), (40 * 16, 4), (40 * 16 - 1, 8), (1, 8)])
def test_the_budget_chooses_the_smallest_block_with_which_it_pays_for_forty_iterations(budget, block):
    class Costly(Toy):
        def loss(self, iteration):
            assert schedule_position(iteration) == 99  # where a renderer has its final number of samples
            self.counts.add("value", self.cost)
            return {"total": self.radius**2}

    made = []

    def make(task):
        problem = Costly()
        problem.cost = 256 // task.pixel_block**2
        made.append((task.pixel_block, problem))
        return problem

    task = Sampled(OptimiserSettings(100, 0.05, "constant", budget))
    problem = with_affordable_rays(task, make)
    assert made[-1] == (block, problem) and problem.counts.cost == 0  # a new one
    assert [blocks for blocks, _ in made[:-1]] == [side for side in (1, 2, 4, 8) if side <= block]
    made.clear()
    assert with_affordable_rays(replace(task, pixel_block=2), make) is made[0][1] and len(made) == 1


def test_noise_moves_the_initial_parameters_of_a_second_start():
    radii = []
    for noise in (0.0, 1e-6):
        toy, history = Toy(), History()
        settings = OptimiserSettings(2, 1e-9, "constant", start_noise=noise)
        optimise(toy, settings, CPU, history=history, on_step=lambda line: None)
        radii.append(toy.radius.detach().clone())
    change = (radii[1] - radii[0]).abs().max()
    assert 0 < change < 1e-5
