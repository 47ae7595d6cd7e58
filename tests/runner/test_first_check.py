"""Runs of a renderer with wrong hits have notes or fail; hits of shipped renderers: tests/renderers/test_hits.py."""

from tests.runner.driving import SMALLEST, record_of

SHORT = ("task=completion", *SMALLEST, "task.optimiser.iterations=4", "view.resolution=32", "task.points=100")
WRONG = (*SHORT, "renderer=custom", "renderer._target_=tests.wrong_hits.WrongHits")
WORDS_OF_NOTES = ("hits", "own image")


def run(isolated, *arguments: str) -> tuple[int, dict]:
    code, out, _ = isolated(*arguments)
    return code, record_of(out)


def on_hits(record: dict) -> list[str]:
    return [note for note in record["notes"] if any(word in note for word in WORDS_OF_NOTES)]


def test_hits_that_are_5_percent_short_are_noted(isolated):
    code, record = run(isolated, *WRONG, "+renderer.how=short")
    (note,) = on_hits(record)
    assert (code, record["status"]) == (0, "ok")
    assert note.startswith("at the first iteration, WrongHits.render: ") and "are not on the surface" in note


def test_hits_behind_the_camera_end_the_run(isolated):
    code, record = run(isolated, *WRONG, "+renderer.how=behind")
    assert (code, record["status"]) == (1, "crashed")
    assert record["reason"].startswith("WrongHits.render: ") and "hits have a negative distance" in record["reason"]
    assert record["metrics"] == {} and record["metrics_start"]["chamfer_l2"] > 0


def test_a_nan_loss_leaves_the_shape_unchanged(isolated):
    code, record = run(isolated, *WRONG, "+renderer.how=endless")
    assert (code, record["status"]) == (1, "nan")
    assert record["reason"].startswith("the depth term is not a number at iteration 0: 11 of 1,024 rays have a hit ")
    assert record["reason"].endswith("(the field is finite on them, so the renderer is at fault)")
    assert record["metrics"] == record["metrics_start"]
    assert record["evaluations"]["iterations"] == 1 and record["evaluations"]["gradient"] == 0
    (note,) = on_hits(record)
    assert note.startswith("the depth error of the renderer's own image is inf, and that of the mesh is ")
