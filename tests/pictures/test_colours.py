"""A run that fits shape and colour to one image: its metrics and its pictures."""

from pathlib import Path

import numpy as np
import pytest

from tests.runner.driving import command, record_of


@pytest.mark.slow
def test_a_command_fits_shape_and_colour_to_one_image(tmp_path):
    small = ("scale=smoke", "isolation=off", "evaluation.grid=24", "evaluation.points=200", "evaluation.gallery=32")
    small += ("evaluation.picture=16", "task.optimiser.iterations=4", "prior.shapes=2", "prior.steps=100", "threads=1")
    small += ("dataset=ellipsoid", "dataset.resolution=24", "prior.network.width=32", "prior.samples=2000")
    code, out, err = command("+method=dist_colour", *small, "split=train", f"results_dir={tmp_path}")
    assert code == 0 or "did not fall" in err, err
    record, folder = record_of(out), Path(out.splitlines()[-1])
    metrics, before = record["metrics"], record["metrics_start"]
    assert 0 < metrics["colour_error"] < 1 and before["colour_error"] < 1
    assert (metrics["code_bytes"], metrics["texture_bytes"] > 0, metrics["mesh_bytes"] > 0) == (4 * 64, True, True)
    assert {*metrics} <= {*record["definitions"]} and (folder / "colours.png").stat().st_size > 2000
    with np.load(folder / "images.npz") as stored:
        arrays = {name: stored[name].astype(float) for name in stored}
    for kind in ("", "trained_", "true_"):
        for side, size in {"size_0": 4, "size_1": 8, "size_2": 32, "turned_0": 32, "turned_1": 32}.items():
            hit = arrays[f"{kind}{side}_hit"]
            assert hit.shape == (size, size) and not arrays[f"{kind}{side}_colours"][hit == 0].any()
            assert kind != "true_" or 0.05 < hit.mean() < 0.9
    small, large = arrays["true_size_1_colours"], arrays["true_size_2_colours"]
    # Both images are of the same camera.
    assert np.abs(large.reshape(8, 4, 8, 4, 3).mean(axis=(1, 3)) - small).mean() < 0.1
    assert np.abs(arrays["true_turned_0_colours"] - large).mean() > 0.03
