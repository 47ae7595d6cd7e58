"""The shipped networks: they belong to the default settings, are small, and beat the mean code."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bench.setup.inputs import prepare_run
from bench.tasks.single_view.store import SHIPPED, overlap
from datasets.scene import Split
from tests.tiny import CPU, plain

NETWORKS = sorted(SHIPPED.glob("*.safetensors"))
LEAST_IOU = {"car": 0.6, "sofa": 0.6, "plane": 0.5, "table": 0.4}  # planes and tables are thin


def test_each_family_has_a_network():
    assert {path.stem.split("-")[1] for path in NETWORKS} == set(LEAST_IOU)
    assert {path.stem for path in SHIPPED.glob("*.json")} == {path.stem for path in NETWORKS}


@pytest.mark.parametrize("path", NETWORKS, ids=[path.stem.split("-")[1] for path in NETWORKS])
def test_a_network_belongs_to_the_default_settings_and_generalises(path, compose_config, tmp_path):
    family = path.stem.split("-")[1]
    config = compose_config("+method=single_view", f"dataset={family}", f"results_dir={tmp_path}")
    task, inputs = prepare_run(plain(config))
    recipe = task.recipe(inputs, plain(config))
    assert recipe.find(inputs.cache) == path and path.stat().st_size < 3_500_000
    model, record = recipe.load(path)
    assert record["status"] == "ok" and record["key"] == recipe.key and record["filled"] > 0.2
    assert record["validation"]["iou_network"] > record["validation"]["iou_mean_code"] + 0.03
    imaging = replace(recipe.imaging, photography=replace(recipe.imaging.photography, views=2))
    unseen = [imaging.shape_images(recipe.dataset, Split.VALIDATION, index) for index in range(3)]
    predicted = [overlap(model.at(model(images.image(0)[None])[0]), images, CPU) for images in unseen]
    mean = [overlap(model.at(torch.tensor(record["mean_code"])), images, CPU) for images in unseen]
    assert np.mean(predicted) > max(np.mean(mean), LEAST_IOU[family])
    text = path.with_suffix(".json").read_text()
    assert not any(f'"/{folder}' in text for folder in ("tmp", "home", "root"))
