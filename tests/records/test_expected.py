"""What a run will take is what like runs took; what a sweep has left follows what it was seen to take."""

import pytest

from bench.records.expected import Model, Remaining


def run(total=10.0, *, cpu="A", status="ok", memory=1000, dataset="sofa", renderer="dist", task="completion", **config):
    node = {"optimiser": {"iterations": config.pop("iterations", 20)}, "points": 100}
    return {
        "task": task, "renderer": renderer, "dataset": dataset, "method": "", "status": status,
        "seconds": {"total": total}, "peak_memory_bytes": memory, "environment": {"cpu": cpu},
        "config": {"scale": {"name": "smoke"}, "view": {"resolution": 32}, "task": node, "device": "auto", **config},
    }  # fmt: skip


def test_it_is_the_median_of_like_runs_with_their_spread():
    found = Model([run(seconds, memory=seconds) for seconds in (1.0, 2.0, 3.0, 4.0, 90.0)], "A").of(run())
    assert (found.seconds, found.low, found.high, found.n) == (3.0, 2.0, 4.0, 5)
    assert (found.memory, found.like) == (90.0, "like runs")
    few = Model([run(1.0), run(5.0, memory=None)], "A").of(run())
    assert (few.seconds, few.low, few.high, few.n, few.memory) == (3.0, 1.0, 5.0, 2, 1000)


@pytest.mark.parametrize(("known", "like"), [
    (run(dataset="car"), "runs on other shapes"),
    (run(cpu="B"), "runs on other machines or threads"),
    (run(threads=4), "runs on other machines or threads"),
    (run(renderer="dvr", cpu="B"), "runs of other renderers"),
    (run(iterations=100), "runs of other sizes"),
    (run(view={"resolution": 64}), "runs of other sizes"),
])  # fmt: skip
def test_it_widens_step_by_step_and_says_to_what(known, like):
    assert Model([known], "A").of(run()).like == like
    nearest = Model([known, run(3.0)], "A").of(run())
    assert (nearest.seconds, nearest.like) == (3.0, "like runs")


@pytest.mark.parametrize("known", [
    run(task="pose"), run(scale={"name": "desk"}), run(status="crashed"), run(status="killed"), run(status="oom"),
    run(float("inf")), run(None), run(0.0),
])  # fmt: skip
def test_some_runs_are_like_no_other(known):
    assert Model([known], "A").of(run()) is None


@pytest.mark.parametrize("config", [
    {"scale": None, "view": None}, {"scale": 3, "view": [], "task": "x"}, {"scale": {"name": [1]}, "threads": [2]},
])  # fmt: skip
def test_a_record_of_another_kind_is_taken_as_it_is(config):
    assert Model([run(**config)], "A").of(run()) is None


def expected(*totals):
    """What cells are expected to take, one cell for each number; None for one without a like run."""
    return {str(n): None if total is None else Model([run(total)], "A").of(run()) for n, total in enumerate(totals)}


def test_before_the_first_cell_the_time_left_is_the_sum_for_the_workers():
    assert Remaining(expected(10.0, 20.0, 30.0), workers=2).left(0.0) == pytest.approx(30.0)
    assert Remaining(expected(10.0, 20.0, None), workers=1).left(0.0) == pytest.approx(45.0)
    assert Remaining(expected(None, None), workers=1).left(5.0) is None


def after(left: Remaining, *seconds: float, pause: float = 0.0) -> float:
    """Lets the first cells end one after another, each after its seconds; gives the time of the last end."""
    elapsed = 0.0
    for cell, spent in enumerate(seconds):
        elapsed += (spent + pause) / left.workers
        left.ended(str(cell), run(spent), elapsed)
    return elapsed


def test_each_cell_counts_as_long_as_it_is_expected_to_take():
    left = Remaining(expected(10.0, 10.0, 100.0), workers=1)
    assert after(left, 10.0) == 10.0 and left.left(10.0) == pytest.approx(110.0)
    assert after(left, 10.0, 10.0) == 20.0 and left.left(20.0) == pytest.approx(100.0)
    after(left, 10.0, 10.0, 100.0)
    assert left.left(120.0) == 0.0


def test_what_is_under_way_is_partly_done():
    left = Remaining(expected(10.0, 10.0, 100.0, 30.0), workers=1)
    after(left, 10.0, 10.0)
    assert [left.left(time) for time in (20.0, 60.0, 110.0)] == pytest.approx([130.0, 90.0, 40.0])
    assert left.left(500.0) == pytest.approx(30.0)  # it takes longer than expected: the next one is still to come
    two = Remaining(expected(*[10.0] * 6), workers=2)
    after(two, 10.0, 10.0)
    assert [two.left(time) for time in (10.0, 15.0, 99.0)] == pytest.approx([20.0, 15.0, 10.0])


@pytest.mark.parametrize("workers", [1, 4])
def test_a_slower_machine_is_noticed(workers):
    left = Remaining(expected(*[10.0, 30.0] * 50), workers)
    assert left.left(after(left, *[20.0, 60.0] * 25)) == pytest.approx(2000.0 * 2 / 2 / workers)
    plain = Remaining(expected(*[None] * 100), workers)
    assert plain.left(after(plain, *[20.0] * 50)) == pytest.approx(1000.0 / workers)  # by what was measured alone


def test_one_cell_alone_is_half_believed():
    left = Remaining(expected(10.0, 10.0), workers=1)
    assert left.left(after(left, 30.0)) == pytest.approx(20.0)


def test_a_cell_that_took_far_too_long_does_not_stand_for_the_others():
    left = Remaining(expected(*[10.0] * 10), workers=2)
    assert left.left(after(left, 11.0, 3600.0, 11.0, 11.0, 11.0)) == pytest.approx(5 * 11.0 / 2)


@pytest.mark.parametrize("ended", [
    {"status": "crashed"}, {"status": "killed"}, {"status": "refused"}, {"status": "unsupported"}, {"reused": True},
])  # fmt: skip
def test_a_cell_that_did_not_take_its_whole_time_does_not_stand_for_the_others(ended):
    left = Remaining(expected(*[10.0] * 5), workers=1)
    for cell in "012":
        left.ended(cell, run(0.1) | ended, 0.3)
    assert left.left(0.3) == pytest.approx(20.0)


def test_the_time_between_cells_counts():
    left = Remaining(expected(*[2.0] * 10), workers=1)
    assert left.left(after(left, *[2.0] * 4, pause=0.5)) == pytest.approx(6 * 2.5)


def test_cells_that_are_reused_take_no_time():
    left = Remaining(expected(10.0, 10.0), workers=1)
    left.ended("reused", run(10.0), 0.5)
    assert left.left(0.0) == pytest.approx(20.0)


def test_it_says_for_how_long_like_runs_waited_for_a_processor():
    runs = [run(10.0) for _ in range(3)]
    for share, one in zip((0.2, 0.5, None), runs, strict=True):
        one["environment"]["waited_share"] = share
    assert Model(runs, "A").of(run()).waited == pytest.approx(0.35)
    assert Model([run()], "A").of(run()).waited == 0.0
