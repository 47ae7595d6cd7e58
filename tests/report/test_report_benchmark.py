"""The page of renderers that were timed in turn."""

from bench.records.read import read_records
from bench.report.data.experiments import choose
from bench.report.pages.rendering import benchmark
from tests.report.test_report_paper import told, write_run


def numbers(factor: float, coarse: int = 0) -> dict:
    """The numbers of a renderer that takes `factor` times what the first one does."""
    ratios = {f"{cost}_ratio": factor for cost in benchmark.COSTS}
    ends = {
        f"{cost}_ratio_{end}": factor + off for cost in benchmark.COSTS for end, off in (("low", -0.25), ("high", 0.25))
    }
    costs = {"forward_seconds": factor, "step_seconds": 2 * factor, "forward_cpu": factor, "step_cpu": factor}
    errors = {"lost": 1, "false": 2, "wrong": 3, "depth_error_median": 1e-6, "depth_error_p99": 1e-4, "hits": 9}
    return {**ratios, **ends, **costs, **errors, "queries": 1000, "coarse_queries": coarse, "work_over_bound": 5.5}


def write(results, size: int, threads: int, factor: float = 0.5, **changed) -> None:
    metrics = {"rounds": 5}
    for name, times, coarse in (("base", 1.0, 0), ("newton", factor, 3000)):
        metrics |= {f"{name}.{key}": number for key, number in numbers(times, coarse).items()}
    definitions = {"forward_ratio, step_ratio": "over the first renderer's"}
    write_run(
        results, "benchmark", None, task="ablation", metrics=changed.pop("metrics", metrics), definitions=definitions,
        settings={"task": {"size": size, "threads": threads}}, **changed,
    )  # fmt: skip


def page(results):
    return benchmark.make(choose(read_records(results)[0], benchmark.READS[0], results))


def test_there_is_a_line_for_each_size_number_of_threads_and_renderer(tmp_path):
    for size, threads, factor in ((256, 1, 0.6), (128, 2, 0.5), (128, 1, 0.75)):
        write(tmp_path, size, threads, factor)
    made = page(tmp_path)
    data = made.data
    assert list(zip(data["size"], data["threads"], data["forward_ratio"], strict=True)) == [
        (128, 1, 1.0), (128, 1, 0.75), (128, 2, 1.0), (128, 2, 0.5), (256, 1, 1.0), (256, 1, 0.6),
    ]  # fmt: skip
    assert set(data["renderer"][1::2]) == {"newton"}
    line = made.table.iloc[1]
    assert line["Values"] == "1.00k + 3.00k coarse"
    assert line["Forward ratio"] == "0.75 (0.50–1.00)"
    assert made.table.iloc[0]["Forward ratio"] == "1"
    assert line["Missed / spurious / wrong depth"] == "1 / 2 / 3"
    assert "medians of 5 rounds" in told(made)
    assert "over the first renderer's" in told(made)


def test_a_run_that_failed_has_a_line_without_numbers(tmp_path):
    write(tmp_path, 128, 1, metrics={}, status="timeout", reason="dvr: more than 9 field values")
    made = page(tmp_path)
    assert len(made.table) == 1
    assert made.table.iloc[0]["Forward ratio"] == "–"
    assert "timeout" in told(made)
