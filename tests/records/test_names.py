"""The name of a run is what differs among the runs, and nothing else."""

from bench.records.metrics import better_direction
from bench.records.names import differences
from tests.looped import each


def run(renderer: str = "dist", label: str = "DIST", **config) -> dict:
    """The fields of a record that a name depends on; `__` in a key of the configuration stands for a dot."""
    nested: dict = {"renderer": {"_label_": label}, "seed": 0, "index": 0}
    for key, value in config.items():
        outer, _, inner = key.partition("__")
        nested[outer] = {**nested.get(outer, {}), inner: value} if inner else value
    return {"task": "completion", "method": "", "renderer": renderer, "dataset": "sofa", "config": nested}


def custom_run(path: str) -> dict:
    return run("custom", path.rpartition(".")[2], renderer___target_=path)


@each("records, names", [
        ([run(), run("dvr", "DVR")], ["DIST", "DVR"]),
        ([run(seed=0), run(seed=1)], ["seed 0", "seed 1"]),
        ([run(), run("dvr", "DVR", index=1), run("dvr", "DVR")], ["DIST", "DVR, shape 1", "DVR, shape 0"]),
        ([run(renderer__epsilon=1e-4), run(renderer__epsilon=5e-5)], ["epsilon 0.0001", "epsilon 5e-05"]),
        ([run(), run("dvr", "DVR", renderer__n=8), run("dvr", "DVR", renderer__n=9)], ["DIST", "DVR, n 8", "DVR, n 9"]),
        ([run("dist"), run("dist_fast")], ["dist", "dist_fast"]),
        ([run(task__steps=1, prior__steps=1), run(task__steps=2, prior__steps=1)], ["steps 1", "steps 2"]),
        ([run(scale__name="smoke", view__resolution=8), run(scale__name="desk", view__resolution=9)],
         ["scale smoke", "scale desk"]),
        ([run(silhouette___label_="hinge"), run()], ["hinge", "DIST"]),
        ([run(time_limit=1), run(time_limit=2)], ["DIST", "DIST"]),
        ([run(a__n=1, b__n=1), run(a__n=1, b__n=2), run(a__n=2, b__n=2)],
         ["n 1, b.n 1", "n 1, b.n 2", "n 2"]),
        ([run()], ["DIST"]),
    ])  # fmt: skip
def test_a_name_is_what_differs(records, names):
    assert differences(records) == names


def test_user_renderers_are_named_by_their_classes():
    classes = [f"bad.{letter * 3}" for letter in "ABCDEFGHIJKL"]
    assert differences([custom_run(path) for path in classes]) == [path[4:] for path in classes]
    assert differences([custom_run("mine.Net"), custom_run("yours.Net")]) == ["mine.Net", "yours.Net"]


def test_what_a_caption_distinguishes_is_not_in_names():
    records = [run(seed=seed, renderer__alpha=alpha) for seed in (0, 1) for alpha in (1.0, 1.5)]
    names = differences(records, distinguished_by=lambda record: record["config"]["seed"])
    assert names == ["alpha 1", "alpha 1.5"] * 2


def test_a_key_is_named_as_in_the_sweep():
    records = [run(renderer__steps=n, renderer__budget=2 * n) for n in (4, 8)]
    assert differences(records) == ["steps 4", "steps 8"]
    overrides = [{"renderer.budget": "8.0"}, {"renderer.budget": "1e1"}]
    assert differences(records, swept=overrides) == ["budget 8.0", "budget 1e1"]


@each(
    "name, direction",
    [("chamfer_l2", "lower"), ("own_psnr", "higher"), ("seen_fscore", "higher"), ("queries", ""), ("own_queries", "")],
)
def test_which_direction_of_a_metric_is_better(name, direction):
    assert better_direction(name) == direction
