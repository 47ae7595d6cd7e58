import math

import numpy as np
import pytest
from scipy import stats

from bench.report.data.statistics import (
    MIN_SHAPES,
    Interval,
    Verdict,
    bootstrap,
    clopper_pearson,
    dominated,
    front,
    interquartile_mean,
    median,
    rank,
    rank_correlation,
    ratio,
    ratio_verdicts,
    shapes_agreeing,
    shapes_needed,
    shapes_won,
    share,
    smallest_significant_correlation,
    tied_with_best,
    typical,
)
from tests.looped import each

INF = math.inf


def singles(*values: float) -> list[np.ndarray]:
    """Groups of one seed each."""
    return [np.array([value], dtype=float) for value in values]


def mean(values: np.ndarray) -> np.ndarray:
    return values.mean(axis=-1)


def seen(statistic) -> tuple:
    """A statistic that notes what it gave for draws."""
    noted = []

    def noting(values):
        result = statistic(values)
        if values.ndim == 2 and values.shape[0] > 1:
            noted.extend(result)
        return result

    return noting, noted


@each(
    "values, expected",
    [
        ([7], 7),
        ([1, 4], 2.5),
        ([12, 0, 3], 4),  # weights 1/4, 1, 1/4 of 1.5
        ([0, 100, 2, 1], 1.5),
        ([0, 1, 2, 4, 100], (0.75 * 1 + 2 + 0.75 * 4) / 2.5),
        ([0, 0, 1, 2, 4, 9], (0.5 * 0 + 1 + 2 + 0.5 * 4) / 3),
        ([0, 1, 2, INF], 1.5),  # a failure in the outer quarter costs no more than a bad run
        ([0, 1, INF, INF], INF),
        ([0, 1, INF], INF),  # of three, each end counts in part
        ([INF], INF),
    ],
)
def test_interquartile_mean_closed_form(values, expected):
    assert interquartile_mean(values) == pytest.approx(expected)


def test_interquartile_mean_is_a_trimmed_mean_and_reduces_the_last_axis():
    values = np.random.default_rng(0).lognormal(size=(3, 5, 12))
    expected = stats.trim_mean(values, 0.25, axis=-1)
    np.testing.assert_allclose(interquartile_mean(values), expected)
    assert interquartile_mean(values[1, 2]) == pytest.approx(expected[1, 2])


@each("values", [[], [1.0, math.nan], [1.0, -INF], np.zeros((3, 0))])
@each("average", [interquartile_mean, median])
def test_averages_refuse_what_is_no_error(average, values):
    with pytest.raises(ValueError, match="values must be"):
        average(values)


def test_interval_of_a_mean_is_that_of_student():
    # A draw's mean varies by the shapes' variance (over n) and by the seeds' within a shape. With one seed the widening
    # makes it mean +- t s / sqrt(n), s with n - 1 in the denominator; a plain percentile would be narrower by 11 %.
    n, t = 16, stats.t.ppf(0.975, 15)
    shapes = 10 + stats.norm.ppf((np.arange(n) + 0.5) / n)[:, None]
    interval = bootstrap(list(shapes), mean, seed=0, draws=40_000)
    half = t * shapes.std(ddof=1) / math.sqrt(n)
    assert interval.value == pytest.approx(10)
    assert (interval.low, interval.high) == pytest.approx((10 - half, 10 + half), abs=0.03 * half)

    groups = shapes + np.array([-2.0, 0, 2])
    interval = bootstrap(list(groups), mean, seed=0, draws=40_000)
    half = t * math.sqrt((shapes.var() + groups[0].var() / 3) / (n - 1))
    assert (interval.low, interval.high) == pytest.approx((10 - half, 10 + half), abs=0.03 * half)


def test_of_six_shapes_an_interval_leaves_out_a_quarter_of_a_per_cent_of_draws_on_each_side():
    # Hesterberg 2015: at the normal's tail beyond sqrt(n / (n - 1)) times Student's quantile with n - 1 degrees.
    noting, noted = seen(mean)
    interval = bootstrap(list(np.random.default_rng(0).normal(size=(6, 40))), noting, seed=0, draws=10_000)
    tail = stats.norm.cdf(math.sqrt(6 / 5) * stats.t.ppf(0.025, df=5))
    assert tail == pytest.approx(0.00243, abs=5e-6)
    for beyond in (np.array(noted) < interval.low, np.array(noted) > interval.high):
        assert tail - 1e-4 < beyond.mean() <= tail  # ends are draws, and never too narrow


@each("n", [1, 4, 5])
def test_fewer_than_six_shapes_have_points_and_no_interval(n):
    groups = [np.array([i, i + 2.0]) for i in range(n)]
    for found in (bootstrap(groups, mean, seed=0), share(np.ones(n), 2 * np.ones(n))):
        assert math.isnan(found.low) and math.isnan(found.high) and not found.has_ends and len(found.points) == n
        assert str(found).endswith(f" (n = {n})")
    found = bootstrap(groups, mean, seed=0)
    assert found.value == n / 2 + 0.5 and found.points == tuple(i + 1.0 for i in range(n))
    six = bootstrap(singles(*range(6)), mean, seed=0)
    assert MIN_SHAPES == 6 and six.has_ends and str(six) == f"2.50 {six.ends()}"


def test_shapes_with_unequal_numbers_of_seeds():
    # A draw that takes the shape of three seeds k times has 3 k ones among 6 + 2 k runs.
    noting, noted = seen(mean)
    groups = [*singles(0, 0, 0, 0, 0), np.ones(3)]
    assert bootstrap(groups, noting, seed=0, draws=8000).value == 3 / 8
    times = np.arange(7)
    expected = stats.binom(6, 1 / 6).pmf(times)
    values, counts = np.unique(np.round(noted, 6), return_counts=True)
    assert values == pytest.approx(np.round(3 * times / (6 + 2 * times), 6)[: len(values)])
    assert counts / 8000 == pytest.approx(expected[: len(values)], abs=0.02)


def test_views_and_seeds_are_drawn_within_their_shape():
    # A mean's variance over draws: of shapes over 6, of views in a shape over 12, of seeds in a view over 36.
    shapes, views, seeds = np.arange(6.0)[:, None, None] * 3, np.array([-2.0, 2.0])[:, None], np.array([-1.0, 0.0, 1.0])
    noting, noted = seen(mean)
    groups = [list(shape) for shape in shapes + views + seeds]
    assert bootstrap(groups, noting, seed=0, draws=20_000).value == pytest.approx(7.5)
    assert np.var(noted) == pytest.approx(shapes.var() / 6 + views.var() / 12 + seeds.var() / 36, rel=0.03)


@each("average", [interquartile_mean, median, mean])
def test_failures_make_infinite_ends(average):
    assert bootstrap(singles(*[INF] * 6), average, seed=0) == Interval(INF, INF, INF)
    half, again, other = (bootstrap(singles(1, 2, 3, 4, 5, INF, INF, INF), average, seed=seed) for seed in (0, 0, 1))
    assert half.low < 5 and half.high == INF and half == again and half.value == other.value
    uneven = bootstrap([np.array([1.0, INF]), *singles(INF, 2, 2, 2), np.array([3.0, 4.0])], average, seed=0)
    assert uneven.low < 3 and uneven.high == INF


def test_bad_groups():
    for groups in ([], [np.ones(2), np.ones(0)], [np.array([1.0, math.nan])]):
        with pytest.raises(ValueError, match="must"):
            bootstrap(groups, median, seed=0)
    for other in (singles(1, 2), [np.ones(1), np.ones(2), np.ones(1)]):
        with pytest.raises(ValueError, match="same shapes and seeds"):
            front([(singles(1, 2, 3), other)])


@each("successes, n", [(0, 10), (3, 10), (10, 10), (1, 1), (17, 400)])
def test_clopper_pearson_is_the_exact_interval(successes, n):
    expected = stats.binomtest(successes, n).proportion_ci(method="exact")
    interval = clopper_pearson(successes / n, n)
    assert (interval.low, interval.value, interval.high) == pytest.approx((expected.low, successes / n, expected.high))


def test_a_share_counts_shapes_not_trials():
    successes, trials = np.array([8, 8, 8, 8, 4, 0.0]), np.full(6, 8.0)
    found = share(successes, trials)
    assert found == clopper_pearson(36 / 48, 6) and found.points == (1, 1, 1, 1, 0.5, 0)
    assert share(10 * successes, 10 * trials) == found
    for bad in (([1.0], [0.0]), ([3.0], [2.0]), ([-1.0], [2.0]), ([], []), ([1.0], [1.0, 1.0])):
        with pytest.raises(ValueError, match="successes must be"):
            share(np.array(bad[0]), np.array(bad[1]))
    for value, n in ((0.5, 0), (-0.1, 3), (1.1, 3)):
        with pytest.raises(ValueError, match="count the trials"):
            clopper_pearson(value, n)


def test_one_run_of_each_gives_no_probability_and_no_rank():
    assert np.isnan(front([point([1], [1]), point([2], [2])], seed=0)).all()
    assert front([point([1, 1], [1, 1]), point([2, 2], [2, 2])], seed=0) == [1, 0]
    assert all(math.isnan(found.value) for found in rank({"a": {"cow": 1.0}, "b": {"cow": 2.0}}).values())


def test_rank_worked_example():
    table = {
        "a": {"cow": 1.0, "car": 2.0, "sofa": None, "hat": INF},
        "b": {"cow": 1.0, "car": 1.0, "sofa": math.nan},
        "c": {"cow": 3.0, "sofa": 5.0},
    }
    # cow 1.5, 1.5, 3; car 2, 1, fails; sofa fails, fails, 1; a hat nobody makes does not count; failing has rank 3
    expected = {"a": (1.5 + 2 + 3) / 3, "b": (1.5 + 1 + 3) / 3, "c": (3 + 3 + 1) / 3}
    assert {name: found.value for name, found in rank(table).items()} == pytest.approx(expected)
    assert [found.value for found in rank({"a": {"cow": None, "car": None}, "b": {}}).values()] == [2, 2]
    assert rank({}) == {}


def test_a_rank_has_an_interval_over_shapes_and_those_that_do_not_differ_from_the_best_are_named():
    places = range(12)
    table = {
        "best": {i: 1.0 for i in places},
        "tied": {i: 0.5 if i % 2 else 2.0 for i in places},
        "last": {i: 3.0 for i in places},
    }
    found = rank(table)
    assert found["last"].value == found["last"].low == found["last"].high == 3
    assert found["tied"].low < found["tied"].value == 1.5 < found["tied"].high
    assert tied_with_best(found, "best") == ["tied"]
    paired = {"best": Interval(5, 1, 9, (1, 9) * 6), "next": Interval(6, 2, 10, (2, 10) * 6)}  # worse on each shape
    assert tied_with_best(paired, "best") == []


def test_a_shape_at_which_both_are_equally_good_is_half_a_success():
    seeds = [np.array([1.0, 2.0, 9.0]), np.array([1.0, 5.0, 5.0])]  # medians 2 and 5
    assert shapes_won(seeds, singles(3, 4)) == 1 and shapes_won(singles(1, 2, 3, INF), singles(2, 2, 2, INF)) == 2


def test_dominated():
    costs, errors = [1, 2, 2, 3, 3, 1], [3, 2, 4, 1, 1, INF]
    assert dominated(costs, errors).tolist() == [False, False, True, False, False, True]  # equal points: neither
    assert dominated(np.array([[1, 2], [2, 1]]), np.array([[1, 1], [2, 2]])).tolist() == [[False, True], [True, False]]


def point(costs, errors) -> tuple:
    return singles(*costs), singles(*errors)


def test_front_of_certain_cases():
    ones = (1, 1, 1, 1, 1)
    points = [
        point(ones, (1, 20, 300, 4000, 50000)),
        point(ones, (1.1, 22, 330, 4400, 55000)),  # worse on every shape, though shapes differ far more
        point((2, 2, 2, 2, 2), (0.5, 10, 150, 2000, 25000)),
        point((0.1, 0.1, 0.1, 0.1, 0.1), (INF, INF, INF, INF, INF)),
        point((INF, INF, INF, INF, INF), (0.1, 0.1, 0.1, 0.1, 0.1)),
    ]
    assert front(points, seed=0) == [1, 0, 1, 0, 0]


def test_front_of_uncertain_cases():
    # The first one's median of three draws is 1, not 3, if two or three of them are of two shapes of three: 20 of 27.
    chances = front([point((1, 1, 1), (1, 1, 3)), point((1, 1, 1), (2, 2, 2))], seed=0, draws=8000)
    assert chances == pytest.approx([20 / 27, 7 / 27], abs=0.02)
    # Mirror images: who wins is tossed, and where medians tie both are on the front.
    spread = np.random.default_rng(0).uniform(size=10)
    mirrored = np.append(spread, -spread)
    chances = front([point(np.ones(20), 2 + mirrored), point(np.ones(20), 2 - mirrored)], seed=0)
    assert chances == pytest.approx([0.5, 0.5], abs=0.08)
    # A failure on one shape of two: the median is infinite if it is drawn at all.
    assert front([point((1, 1), (1, INF))], seed=0, draws=8000) == pytest.approx([0.25], abs=0.02)


def test_the_interval_of_a_median_is_that_of_the_sign_test():
    errors = [np.array([1.0, 4.0]), *(np.array([e]) for e in (1.0, 3.0, 4.0, 8.0, 16.0))]
    found = typical(errors)
    assert (found.value, found.low, found.high) == pytest.approx((math.sqrt(12), 1.0, 16.0))  # of six, all
    assert not typical(errors[:5]).has_ends
    failed = typical([*errors, np.array([math.inf])])
    assert (failed.value, failed.high) == (pytest.approx(4.0), math.inf)
    eight = typical([np.array([2.0**k]) for k in range(8)])
    assert (eight.low, eight.high) == pytest.approx((1.0, 128.0))  # beyond the second lie 3.5 % on each side
    twelve = typical([np.array([2.0**k]) for k in range(12)])
    assert (twelve.low, twelve.high) == pytest.approx((4.0, 512.0))  # Conover 1999, Table A3: the third of twelve


def test_holm_takes_the_least_chance_first_and_stops_at_the_first_that_does_not_differ():
    def of(below: int, shapes: int = 12) -> Interval:
        return ratio([np.array([0.5])] * below + [np.array([2.0])] * (shapes - below), [np.array([1.0])] * shapes)

    yes, no = Verdict.DIFFERS, Verdict.NOT_DISTINGUISHED
    assert ratio_verdicts([of(10), of(12)]) == [yes, yes]  # .0005 <= .05 / 2, then .039 <= .05
    assert ratio_verdicts([of(12), of(10), of(10), of(6)]) == [yes, no, no, no]  # .039 > .05 / 3
    assert ratio_verdicts([of(0), of(5, shapes=5)]) == [yes, Verdict.NOT_DECIDABLE]  # five shapes are not counted
    assert ratio_verdicts([]) == []


def test_a_family_that_no_data_could_reject_cannot_be_decided():
    def family(shapes: int, ratios: int) -> list[Interval]:
        return [ratio(singles(*[0.5] * shapes), singles(*[1.0] * shapes))] * ratios

    assert ratio_verdicts(family(6, 1)) == [Verdict.DIFFERS]  # 2 / 2^6 = .031
    assert ratio_verdicts(family(6, 2)) == [Verdict.NOT_DECIDABLE] * 2  # > .05 / 2
    assert ratio_verdicts(family(8, 7)) == [Verdict.NOT_DECIDABLE] * 7  # .0078 > .05 / 7
    assert ratio_verdicts(family(9, 7)) == [Verdict.DIFFERS] * 7
    mixed = ratio_verdicts([*family(6, 1), *family(12, 1)])  # .0005 <= .05 / 2, then .031 <= .05
    assert mixed == [Verdict.DIFFERS] * 2
    assert [shapes_needed(n) for n in (1, 7, 14)] == [6, 9, 10]
    assert [shapes_agreeing(12, 11), shapes_agreeing(12, 1), shapes_agreeing(8, 7)] == [12, 10, 9]


def test_shapes_with_equal_errors_are_no_trials_of_the_sign_test():
    ones = [np.array([1.0])] * 12
    lower, tied = ratio([np.array([0.5])] * 6 + ones[6:], ones), ratio(ones, ones)
    assert ratio_verdicts([lower]) == [Verdict.DIFFERS]  # 6 of 6 trials: p = 2 / 64 = .031
    assert (
        ratio_verdicts([lower, lower]) == [Verdict.NOT_DISTINGUISHED] * 2
    )  # above .05 / 2; of 12 trials p would be .0005
    assert ratio_verdicts([tied]) == [Verdict.NOT_DISTINGUISHED]


def test_a_ratio_is_paired_by_shape():
    first = [np.array([e]) for e in (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)]
    found = ratio([3 * e for e in first], first)
    assert (found.value, found.low, found.high) == pytest.approx((3.0, 3.0, 3.0))
    assert found.points == pytest.approx((3.0,) * 6)
    with pytest.raises(ValueError, match="must have the same shapes"):
        ratio(first, first[:5])


def test_where_both_fail_on_a_shape_the_ratio_is_1():
    good, failed = np.array([2.0]), np.array([np.inf])
    found = ratio([failed, *[2 * good] * 5], [failed, *[good] * 5])
    assert found.points == pytest.approx((1.0, *[2.0] * 5))
    assert (found.value, found.low, found.high) == pytest.approx((2.0, 1.0, 2.0))
    apart = ratio([failed] * 3 + [good] * 3, [good] * 3 + [failed] * 3)  # neither is known to be better
    assert math.isnan(apart.value) and (apart.low, apart.high) == (0.0, math.inf)


def test_a_shape_may_have_views_and_its_runs_another_statistic_than_the_geometric_mean():
    groups = [[np.array([1.0, 2.0]), np.array([math.inf])], [np.array([4.0]), np.array([6.0])]]
    doubled = [[2 * view for view in views] for views in groups]
    assert ratio(doubled, groups, of_shape=median).points == (2.0, 2.0)
    ones = [[np.array([1.0, 1.0]), np.array([1.0])], groups[1]]
    assert ratio(groups, ones, of_shape=median).points == (2.0, 1.0)  # one failed run of three leaves it finite


def test_the_rank_correlation_is_spearman_s():
    draw = np.random.default_rng(0)
    for n in (5, 12, 40):
        first = draw.integers(0, 9, n)  # with equal values
        second = first + draw.integers(0, 9, n)
        expected = stats.spearmanr(first, second)
        assert rank_correlation(first, second) == pytest.approx((expected.statistic, expected.pvalue))
    assert rank_correlation([1, 2, 3, 4], [9, 5, 4, 1])[0] == -1
    smallest = smallest_significant_correlation(12)
    p_values = [2 * stats.t.sf(r * np.sqrt(10 / (1 - r**2)), 10) for r in (smallest - 1e-6, smallest + 1e-6)]
    assert p_values[0] > 0.05 > p_values[1]
    assert math.isnan(rank_correlation([1, 1, 1], [1, 2, 3])[0])
