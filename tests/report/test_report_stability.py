"""The stability atlas as tables and figures, made from run folders whose numbers are known."""

import json
from pathlib import Path

import pytest

from bench.records.shipped import SHIPPED
from bench.report import breakdowns
from bench.report.data.kept import FROM_RUNS_CSV, read_rows
from bench.report.data.records import row_of
from bench.report.data.runs import Runs, choose, named_rows, shared_loss
from bench.report.write.paper import studies
from bench.studies.stability import READS, first_trials
from tests.report.test_report_paper import page_of, told, write_lines, write_run

SWEEP = {"mild": 1.0, "severe": 0.01, "log": True, "unit": "scene units"}


def broke(results, axis, label, level, *, status="ok", measure="rendering", criteria=None, repeats=None, **more):
    """A run of the atlas whose breakdown lies at a level; with a curve of ten trials, or one trial at each end."""
    off, trials = (None, 1) if repeats == 1 else (0.05, 5)
    ends = {"": level, "_low": off and level - off, "_high": off and level + off}
    known = {f"level{end}": at for end, at in ends.items()}
    known |= {f"breakdown{end}": 0.01**at if at is not None and 0 <= at <= 1 else None for end, at in ends.items()}
    known |= {"trials": 10, "grid_trials": 40, "evaluations_per_ray": 4.0, "failed_lost": 3, "failed_false": 1}
    known |= {f"{end}_trials": trials for end in ("mild", "severe")}
    renderer = {name: more.pop(name) for name in ("renderer", "overrides") if name in more}
    settings = {"renderer": {"_target_": more.pop("target")}} if "target" in more else {}
    known |= {"mild_successes": trials * (level > 0), "severe_successes": trials * (level > 1)} | more
    stress = {"scene": axis, "measure": measure, "group": "viewing", "sweep": SWEEP, "repeats": repeats}
    stress |= {"setting": "renderer.alpha"} if axis == "alpha" else {}
    search = {"levels": 11, "repeats": 4}
    folder = write_run(
        *(results, "stability", label),
        task="stability",
        dataset=axis,
        status=status,
        reason="" if status == "ok" else "why",
        metrics=known if status == "ok" else {},
        **renderer,
        settings=settings
        | {
            "task": {"stress": stress, "search": search, "fit_search": search, "criteria": criteria or {}},
            "stress": stress,
        },
    )
    if status == "ok":
        tried = [i / 10 for i in range(11)]
        write_lines(folder, [{"level": at, "severity": 0.01**at, "success": at < level} for at in tried])
    return folder


def test_a_breakdown_stands_with_its_interval(tmp_path):
    broke(tmp_path, "wires", "DIST", 0.5)
    broke(tmp_path, "wires", "DVR", 1.1)
    page = page_of(tmp_path, "stability_axes")
    assert page.table.iloc[0].tolist()[:3] == ["thin wires", "scene units", "0.100 (0.126 to 0.0794)"]
    assert ": *1* (DVR) to 0 (DIST); n = 20 trials on 1 axes. Of 2 pairs of renderer and axis, 1 have" in page.verdict
    assert page.verdict.endswith("1 have it inside the axis, at *50 %* (median; 0 % is the mildest severity).")
    assert "n = 20 trials in all, of 1 axes and 2 renderers" in told(page) and "25 % of the trials" in told(page)
    first = page_of(tmp_path, "stability")
    assert first.data["full"].iloc[0] == "0.100 scene units (0.126 to 0.0794)"
    assert first.data["failures"].tolist() == ["1 false; 3 lost"] * 2
    assert [(cell["shade"], cell["mark"]) for cell in first.atlas["cells"][0]] == [(0.5, ""), (1.0, "")]


def test_a_renderer_has_the_axes_on_which_it_breaks_first_and_the_one_on_which_it_is_best(tmp_path):
    levels = {"wires": (0.5, 0.9), "gap": (-0.1, 0.5), "bumps": (0.2, 0.4), "thin_plate": (1.1, 0.3)}
    for axis, (dist, dvr) in levels.items():
        broke(tmp_path, axis, "DIST", dist)
        broke(tmp_path, axis, "DVR", dvr)
    broke(tmp_path, "alpha", "DIST", 0.01)  # a setting of the renderer is not compared
    page = page_of(tmp_path, "stability")
    rows = page.table.set_index("Renderer")
    at_once, never = "narrow gap, mildest (5 of 5 trials failed)", "thin plate, survives (0 of 5 trials failed)"
    assert rows.loc["DIST"].tolist()[:3] == [at_once, "fine bumps, 20 % [15, 25]", never]
    firsts = ["thin plate, 30 % [25, 35]", "fine bumps, 40 % [35, 45]"]
    assert rows.loc["DVR"].tolist()[:3] == [*firsts, "narrow gap, 50 % [45, 55]"]
    assert "At the mildest severity, narrow gap breaks the largest share of renderers: *1 of 2*." in page.verdict
    labels = [label.get_text() for label in page.figure.axes[0].get_xticklabels()]
    assert labels == ["large alpha", "narrow gap", "fine bumps", "thin plate", "thin wires"]


def test_the_hardest_axis_breaks_the_largest_share_and_equal_breakdowns_inside_sweeps_are_named(tmp_path):
    for renderer, level in (("DIST", 0.5), ("DVR", 0.5), ("IDR", 0.6)):
        for index, axis in enumerate(("wires", "gap", "bumps", "thin_plate", "tiny_objects")):
            broke(tmp_path, axis, renderer, level + index / 100)
        broke(tmp_path, "nan_region", renderer, 1.1)
    broke(tmp_path, "grazing_plane", "IDR", -0.1)
    for renderer, level in (("DIST", -0.1), ("DVR", -0.1), ("IDR", 0.5)):
        broke(tmp_path, "narrow_view", renderer, level)
    page = page_of(tmp_path, "stability")
    assert "grazing plane breaks the largest share of renderers: *1 of 1*." in page.verdict
    assert "Equal breakdowns in all renderings: DIST; DVR." in page.notes


def test_the_shipped_heat_map_has_a_line_per_renderer_and_marks_what_breaks_at_once(tmp_path):
    rows = read_rows(SHIPPED / "paper", "stability")
    cells = breakdowns.cells_of(choose(rows, READS[0], SHIPPED))
    figure = next(study for study in studies() if "stability" in study.pages).results(rows, SHIPPED)["stability"].figure
    panels = figure.axes[:2]
    assert all(len(panel.get_yticklabels()) == 12 for panel in panels)
    assert sum(len(panel.get_xticklabels()) for panel in panels) == cells["axis"].nunique()
    shown = {label.get_text() for label in panels[0].get_yticklabels()}
    crosses = [text for panel in panels for text in panel.texts if text.get_text() == "×"]
    assert len(crosses) == (cells["at_once"] & ~cells["rises"] & cells["row"].isin(shown)).sum() > 0


def test_a_cell_has_the_command_of_a_ray_and_the_levels_around_the_breakdown(tmp_path):
    broke(tmp_path, "wires", "DIST", 0.45, overrides=["renderer.steps=20", "seed=3"])
    broke(tmp_path, "wires", "DVR", 1.1)
    broke(tmp_path, "alpha", "DIST", 0.45)
    broke(tmp_path, "depth_noise", "DIST", 0.45, measure="fit")
    cells = page_of(tmp_path, "stability").atlas["cells"]
    ((dist, dvr),) = [line for line in cells if None not in line]
    others = [line for line in cells if None in line]
    command = "python -m bench.ray task=stability stress=wires renderer=dist renderer.steps=20"
    assert dist["ray"] == {"command": command, "breaks": 0.5, "works": 0.4}
    assert (dvr["ray"]["breaks"], dvr["ray"]["works"]) == (None, 1.0)  # it does not break
    assert [cell["ray"] for line in others for cell in line if cell] == [None, None]


def test_a_cell_has_the_pictures_of_its_own_run(tmp_path):
    for label, level in (("DIST", 0.45), ("DVR", 0.8), ("IDR", 0.2)):
        file = broke(tmp_path, "wires", label, level) / "record.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | {"pictures": {"breaks_text": f"fails at {level}"}}))
    page = page_of(tmp_path, "stability")
    texts = {
        row: cell["pictures"]["breaks_text"]
        for row, cell in zip(page.atlas["rows"], page.atlas["cells"][0], strict=True)
    }
    assert texts == {"DIST": "fails at 0.45", "DVR": "fails at 0.8", "IDR": "fails at 0.2"}


def test_a_shipped_row_has_the_ends_of_the_sweep_at_which_all_trials_agree():
    numbers = {"mild_successes": 5, "mild_trials": 5, "severe_successes": 1, "severe_trials": 5}
    record = {"metrics": numbers, "folder": "gone", FROM_RUNS_CSV: True}
    runs = Runs(READS[0], Path("results"), [record])
    assert first_trials(runs, record) == {0.0: True}
    assert first_trials(runs, record | {"metrics": numbers | {"severe_successes": 0}}) == {0.0: True, 1.0: False}
    pictures = {"works": "", "works_text": "", "works_level": "0.531250", "breaks_level": "0.562500"}
    assert first_trials(runs, record | {"pictures": pictures}) == {0.0: True, 0.53125: True, 0.5625: False}


def test_one_trial_per_level_has_no_interval_anywhere(tmp_path):
    broke(tmp_path, "camera_inside", "DIST", 0.5, repeats=1)
    broke(tmp_path, "camera_inside", "DVR", -0.1, repeats=1)
    result = page_of(tmp_path, "stability")
    assert page_of(tmp_path, "stability_axes").table.loc[0, ["DIST", "DVR"]].tolist() == [
        "0.100 (one trial)",
        "breaks at the mildest (1 of 1 trials failed)",
    ]
    assert result.data[["breakdown_low", "breakdown_high", "level_low", "level_high"]].isna().all(axis=None)
    curves = page_of(tmp_path, "stability_curves").data
    assert curves["share"].notna().all() and curves[["low", "high"]].isna().all(axis=None)


def test_losses_that_differ_are_in_the_names_of_rows():
    def record(loss):
        return {"config": {"silhouette": {"_label_": loss} if loss else {}}, "renderer": "dist"}

    assert shared_loss([record("a"), record("a")]) == "a"
    assert shared_loss([record("a"), record("b")]) == shared_loss([record("a"), record(None)]) == ""
    assert shared_loss([record(None)]) == ""
    assert [row_of(one).name for one in named_rows([record("a"), record("b")])] == ["dist, a", "dist, b"]
    assert [row_of(one).name for one in named_rows([record("a"), record("a")])] == ["dist", "dist"]


def test_the_ends_of_a_sweep_have_the_count_behind_them(tmp_path):
    broke(tmp_path, "wires", "DIST", -0.1)
    broke(tmp_path, "wires", "DVR", 1.1)
    broke(tmp_path, "wires", "IDR", 0.5, mild_successes=1, severe_successes=4)
    row = page_of(tmp_path, "stability_axes").table.iloc[0]
    assert row["DIST"] == "breaks at the mildest (5 of 5 trials failed, 48-100 %)"
    # 0 of 5 still allows 52 %: 1 - 0.025^(1/5)
    assert row["DVR"] == "survives the severest (0 of 5 trials failed, 0-52 %)"
    assert row["IDR"].startswith("success rises with severity (mild: 4 of 5 trials failed")


def test_what_did_not_end_ok_keeps_its_cell(tmp_path):
    broke(tmp_path, "wires", "DIST", 0.5)
    broke(tmp_path, "wires", "DVR", 0.5, status="crashed")
    broke(tmp_path, "alpha", "DIST", 0.5)
    broke(tmp_path, "alpha", "DVR", 0.5, status="unsupported")
    result = page_of(tmp_path, "stability")
    assert list(page_of(tmp_path, "stability_axes").table["DVR"]) == ["crashed", "–"]
    assert [cell["mark"] for line in result.atlas["cells"] for cell in line] == ["", "?", "", "–"]
    assert "2 of 4 runs did not end ok: DVR, wires: crashed (why); DVR, alpha: unsupported (why)." in told(result)
    assert [cell["shade"] for line in result.atlas["cells"] for cell in line] == [0.5, None, 0.5, None]


def test_ranks_leave_out_settings_that_a_renderer_lacks_and_a_refused_field_is_the_worst(tmp_path):
    for label, level in (("DIST", 0.25), ("DVR", 0.75)):
        broke(tmp_path, "wires", label, level, evaluations_per_ray=2.0 if label == "DIST" else 90.0)
        broke(tmp_path, "thin_plate", label, -0.1 if label == "DIST" else 1.1)
        broke(tmp_path, "gap", label, 0.5)
        broke(tmp_path, "depth_noise", label, 0.5, measure="fit")
    broke(tmp_path, "alpha", "DIST", 0.9)
    broke(tmp_path, "alpha", "DVR", 0.9, status="unsupported")
    broke(tmp_path, "csg_difference", "DIST", -0.1)
    broke(tmp_path, "csg_difference", "DVR", 0.9, status="unsupported")
    page = page_of(tmp_path, "stability_cost")
    assert page.chart["panels"][0]["y"]["reversed"] and page.figure.axes[0].yaxis_inverted()
    rows = page.data.set_index("row")
    columns = ["axes", "at_once", "never", "without", "cost"]
    assert rows.loc["DIST", columns].tolist() == [4, 2, 0, 0, 3.0]
    assert rows.loc["DVR", columns].tolist() == [4, 0, 1, 1, 4.0]
    assert rows["rank"].to_dict() == {"DIST": pytest.approx(6.5 / 4), "DVR": pytest.approx(5.5 / 4)}


def test_the_ranking_has_one_row_a_renderer(tmp_path):
    rows = {"+ capped": "dist_capped", "DIST, our default": "dist", "VolSDF, 136 samples": "volsdf_budget"}
    for axis in ("wires", "gap", "thin_plate", "bumps", "nested_shells", "csg_difference"):
        for label, preset in rows.items():
            target = "renderers.VolSDF" if preset == "volsdf_budget" else "renderers.DIST"
            broke(tmp_path, axis, label, 0.5, renderer=preset, target=target)
        for label, level in (("Mine", 0.5), ("Mine, slow", 0.9)):
            broke(tmp_path, axis, label, level, renderer="custom", target="mypkg.Mine")
    page = page_of(tmp_path, "stability_cost")
    assert set(page.data["row"]) == {"DIST, our default", "VolSDF, 136 samples", "Mine", "Mine, slow"}
    assert "4 renderers" in page.caption and "(Mine, slow, 4.00)" in page.verdict
    assert "All others can be distinguished from Mine, slow." in page.verdict
    assert "+ capped" in page_of(tmp_path, "stability_axes").table
    assert "+ capped" not in page_of(tmp_path, "stability").table["Renderer"].tolist()


@pytest.mark.parametrize("status", ["timeout", "missing"])
def test_a_run_that_failed_or_is_missing_has_the_worst_rank(tmp_path, status):
    for label in ("DIST", "DVR"):
        broke(tmp_path, "wires", label, 0.5)
    if status != "missing":
        broke(tmp_path, "thin_plate", "DIST", 0.1, status=status)
    broke(tmp_path, "thin_plate", "DVR", 0.1)
    rows = page_of(tmp_path, "stability_cost").data.set_index("row")
    assert rows["rank"].to_dict() == {"DIST": 1.75, "DVR": 1.25}
    assert page_of(tmp_path, "stability_axes").table.set_index("Axis").loc["thin plate", "DIST"] == (
        "" if status == "missing" else status
    )


def test_rows_of_other_criteria_are_not_compared(tmp_path):
    broke(tmp_path, "wires", "DIST", 0.5, criteria={"hits": 0.5})
    broke(tmp_path, "wires", "DVR", 0.5, criteria={"hits": 0.99})
    result = page_of(tmp_path, "stability_axes")
    assert list(result.table.columns) == ["Axis", "Unit", "DVR"]
    assert "Success: 0.99 of the true hits" in told(result) and "Not shown: 1 run" in told(result)


def test_curves_have_a_line_a_level_with_its_interval_and_a_panel_an_axis(tmp_path):
    broke(tmp_path, "wires", "DIST", 0.45)
    broke(tmp_path, "gap", "DIST", 0.45)
    page = page_of(tmp_path, "stability_curves")
    data = page.data[page.data["axis"] == "wires"]
    assert len(data) == 11 and data["successes"].sum() == 5 and data["level"].iloc[-1] == 1.0
    assert (data["low"] <= data["share"]).all() and (data["share"] <= data["high"]).all()
    assert [panel["axis"] for panel in page.chart["panels"]] == ["wires", "gap"]
    assert page.chart["panels"][0]["series"][0]["y"] == [100] * 5 + [0] * 6


def test_a_curve_that_cannot_be_read_leaves_the_page_without_it(tmp_path):
    folder = broke(tmp_path, "wires", "DIST", 0.5)
    (folder / "curve.jsonl").write_text("not a line\n")
    page = page_of(tmp_path, "stability_curves")
    assert page.data.empty and page.chart["panels"] == []
