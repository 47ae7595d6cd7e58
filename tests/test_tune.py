"""The tuning, from run folders whose errors are known: the best of some draws, and its file."""

import math

import numpy as np
import pytest
import yaml

from bench.records.read import read_records
from bench.report.data.runs import choose
from bench.tables import CONF, choices_of, read_yaml
from bench.tune import HEADER, LINE_WIDTH, TUNING, left_out, main, tunings, write
from tests.report.test_report_paper import write_run

VALIDATION, TEST = (4.0, 1.0, 3.0, 2.0), (5.0, 2.0, 9.0, 1.0)  # errors of four draws
OWN = (1.0, 2.0, 0.5, 4.0, 1.0, 0.25, 8.0)  # of shapes: their geometric mean over the first six is 1
ERRORS = {"validation": VALIDATION, "test": TEST}
RATES = (0.04, 0.01, 0.03, 0.02)


def drawn(
    results, *, shapes=6, method="dist_mask", failed=(), left_out=(), killed=(), scale=1.0, family="sofa", **more
):
    """Four draws of a method; the error of a shape is that of its draw times the shape's own."""
    name = more.pop("experiment", "tuning")
    for split, errors in more.pop("errors", ERRORS).items():
        for draw, value in enumerate(errors):
            for index in (i for i in range(shapes) if (split, draw, i) not in left_out):
                status = {**dict.fromkeys(failed, "empty"), **dict.fromkeys(killed, "killed")}.get((split, draw, index))
                write_run(
                    results,
                    name,
                    "DIST with mask",
                    **{"task": "completion", "dataset": family, "renderer": "dist", "method": f"space/{method}"},
                    status=status or "ok",
                    metrics={} if status else {"chamfer_l2": scale * value * OWN[index] / 1000},
                    evaluations={"value": 100 * (draw + 1)},
                    index=index,
                    settings={
                        **{"split": split, "draw": draw},
                        "dataset": {"name": family, "ranges": {f"width of a {family}": 1.0}},
                        "task": {"points": "20", "_target_": "completion", "optimiser": {"learning_rate": RATES[draw]}},
                        "renderer": {"epsilon": 5e-5, "steps": 10 + draw},
                        "scale": {"name": "desk"},
                        **more,
                    },
                )


def read(results):
    return choose(read_records(results)[0], TUNING, results)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The runs of one method without a failure, written once."""
    results = tmp_path_factory.mktemp("whole")
    drawn(results)
    return read(results)


def test_the_best_is_chosen_on_validation_shapes(whole):
    (method,) = tunings(whole)
    assert (method.method, method.label, method.draws) == ("dist_mask", "DIST with mask", [0, 1, 2, 3])
    assert method.best == 1  # the last draw is better on the test shapes
    assert method.settings[1] == {"task.optimiser.learning_rate": 0.01, "renderer.steps": 11}
    assert method.validation == pytest.approx(np.log(np.outer(VALIDATION, OWN[:6])))


def test_what_families_differ_in_is_no_setting(tmp_path):
    for family in ("sofa", "plane"):
        drawn(tmp_path, family=family, shapes=1)
    (method,) = tunings(read(tmp_path))
    assert method.settings[1] == {"task.optimiser.learning_rate": 0.01, "renderer.steps": 11}


def test_a_failure_counts_as_the_worst_error_of_its_shape_and_its_draw_ranks_behind(tmp_path):
    drawn(tmp_path, failed={("validation", 1, 2)})
    (method,) = tunings(read(tmp_path))
    assert method.validation[1, 2] == pytest.approx(math.log(4 * 0.5))
    assert method.failures.tolist() == [0, 1, 0, 0] and method.order.tolist() == [3, 2, 0, 1]


def test_runs_that_have_not_ended_are_missing_and_not_failed(tmp_path, capsys):
    drawn(tmp_path, killed={("validation", 1, 5)})
    (method,) = tunings(read(tmp_path))
    assert method.draws == [0, 2, 3] and method.draws[method.best] == 3
    assert main(["--results", str(tmp_path), "--into", str(tmp_path / "tuned.yaml")]) == 1
    assert "1 runs of the tuning have not ended" in capsys.readouterr().err
    assert not (tmp_path / "tuned.yaml").exists()


def test_methods_are_read_on_the_draws_and_shapes_that_all_of_them_have(tmp_path):
    drawn(tmp_path, left_out={("test", 2, 0)})
    drawn(tmp_path, method="idr_mask", shapes=7, scale=10)
    first, second = tunings(read(tmp_path))
    assert first.draws == second.draws == [0, 1, 3]
    assert left_out(read(tmp_path), [first, second]) == ["Left out, since a method or a shape lacks them: draws 2."]
    assert first.validation.shape == second.validation.shape == (3, 6)
    assert second.validation == pytest.approx(first.validation + math.log(10))


def test_the_best_is_written_as_a_row_over_its_default(tmp_path, capsys):
    drawn(tmp_path)
    path = tmp_path / "own/tuned.yaml"
    path.parent.mkdir()
    path.write_text("mine_mask: {label: Mine}\ndist_mask: {label: of before}\n")
    assert main(["--results", str(tmp_path), "--into", str(path)]) == 0
    assert f"{path}: dist_mask: " in capsys.readouterr().out
    rows = read_yaml(path)
    assert rows["mine_mask"] == {"label": "Mine"}
    row = rows["dist_mask"]
    assert "draw 1 of 4 of space/dist_mask: geometric mean" in row["chosen"]
    assert "6 validation runs at scale=desk of sofa: 1.00, of the median draw 2.45" in row["chosen"]
    node = choices_of(path.parent)["method/tuned"]["dist_mask"].content
    assert node.pop("defaults") == ["/method/dist_mask", "_self_"]
    assert (node["label"], node["task"]["optimiser"]["learning_rate"]) == ("DIST with mask, tuned", 0.01)
    assert node["renderer"]["steps"] == 11 and set(node) == {"label", "task", "renderer"}


def test_renderers_of_photographs_are_chosen_by_what_is_seen(tmp_path, capsys):
    hinge = {"_target_": "renderers.silhouette.Hinge", "_label_": "DIST's mask loss"}
    under = {"experiment": "tuning_photographs", "silhouette": hinge}
    drawn(tmp_path, method="rgb_dist", errors={"validation": VALIDATION}, **under)
    assert main(["--results", str(tmp_path)]) == 1
    assert "has no runs of the tuning" in capsys.readouterr().err
    for path in tmp_path.glob("runs/*/record.json"):  # the experiment draws, and not the method's space
        text = path.read_text().replace("space/rgb_dist", "rgb_dist").replace("chamfer_l2", "seen_chamfer_l1")
        path.write_text(text)
    assert main(["--experiment", "tuning_photographs", "--results", str(tmp_path)]) == 0
    ((name, row),) = read_yaml(tmp_path / "tuned.yaml").items()
    assert name == "rgb_dist"
    assert row["chosen"].startswith("draw 1 of 4 of tuning_photographs: geometric mean of seen_chamfer_l1 x 1000 on 6")
    assert "of sofa, all under DIST's mask loss: 1.00, of the median draw 2.45" in row["chosen"]
    assert (row["base"], row["task.optimiser.learning_rate"]) == ("/method/rgb_dist", 0.01)


def test_the_shipped_settings_are_as_the_command_writes_them():
    text = (CONF / "tuned.yaml").read_text()
    assert text == HEADER + yaml.safe_dump(yaml.safe_load(text), sort_keys=False, width=LINE_WIDTH)


@pytest.mark.parametrize("place", ["tuned", "conf/method"])
def test_a_folder_is_no_table(tmp_path, capsys, place):
    drawn(tmp_path)
    assert main(["--results", str(tmp_path), "--into", str(tmp_path / place)]) == 1
    assert f"{place} is no table of settings: type --into conf/tuned.yaml" in capsys.readouterr().err


def test_a_setting_that_the_used_draws_share_is_written_too_and_the_others_are_named(tmp_path, capsys):
    drawn(tmp_path, left_out={("test", draw, 0) for draw in (0, 2)})
    drawn(tmp_path, method="idr_mask")
    for path in tmp_path.glob("runs/*/record.json"):
        text = path.read_text().replace('"steps": 13', '"steps": 11')
        path.write_text(text)
    assert main(["--results", str(tmp_path)]) == 0
    assert "lacks them: draws 0, 2" in capsys.readouterr().out
    for name in ("dist_mask", "idr_mask"):
        assert read_yaml(tmp_path / "tuned.yaml")[name]["renderer.steps"] == 11


def test_one_draw_is_no_choice(tmp_path, capsys):
    drawn(tmp_path, left_out={("test", draw, 0) for draw in (0, 2, 3)})
    drawn(tmp_path, method="idr_mask")
    assert main(["--results", str(tmp_path)]) == 1
    assert "draw 1 alone has a run on every shape" in capsys.readouterr().err
    assert not (tmp_path / "tuned.yaml").exists()


def test_without_runs_the_command_says_which_are_needed(tmp_path, capsys):
    (tmp_path / "runs").mkdir()
    assert main(["--results", str(tmp_path)]) == 1
    assert "type python -m bench -m +experiment=tuning" in capsys.readouterr().err
    with pytest.raises(ValueError, match="has no runs of the tuning"):
        write(tmp_path, tmp_path / "tuned.yaml")
