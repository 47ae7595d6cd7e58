"""The tables and figures of the experiments, made from run folders whose numbers are known."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgb

from bench.pictures import style
from bench.records.read import read_records
from bench.report import gallery
from bench.report.__main__ import main
from bench.report.data import curves
from bench.report.data.experiments import Experiment, choose
from bench.report.pages.rendering import fig4, fig7, gradients, gradients_visibility, table1
from bench.report.write import result as tables
from bench.report.write.html import write_index
from bench.report.write.paper import find_paper
from bench.studies import fig5
from tests.report.page_data import Page
from tests.report.test_report import HOSTILE

MACHINE = {"cpu": "Some CPU", "threads": 2, "device": "cpu"}
NETWORK = {"layers": 4, "width": 128}
DYNAMIC, PARALLEL, NAIVE = "+ dynamic", "+ parallel", "Naive sphere tracing"
PRESETS = {DYNAMIC: "dist_dynamic", PARALLEL: "naive_practical_parallel", NAIVE: "naive_serial"}
PRESETS |= {"+ aggressive": "dist_aggressive", "DIST with mask": "dist_mask", "Naive with mask": "naive_mask"}
PAGES = {"table1": table1, "fig4": fig4, "fig5": fig5, "fig7": fig7, "gradients": gradients}


def write_run(results: Path, experiment: str | None, label: str | None, **changed) -> Path:
    """Writes a run folder whose record is an ok one of the experiment, and gives the folder.

    `changed` are fields of the record; `settings` those of its configuration, `minute` when it started. The label's
    preset is the renderer's, or, where it is a method, the method's.
    """
    number = len(list((results / "runs").glob("*")))
    settings, minute = changed.pop("settings", {}), changed.pop("minute", number)
    task = {"fig5": "completion", "gradients": "gradients"}.get(experiment or "", "ablation")
    config = {"experiment": experiment, "label": label, "index": 0, "seed": 0, "view": {"resolution": 64}}
    config |= {"renderer": {"epsilon": 5e-5}, "prior": {"network": NETWORK}, "results_dir": str(results)} | settings
    record = {"schema": 1, "id": str(number), "task": task, "dataset": "car", "scene": "car 0"}
    preset = PRESETS.get(label or "", "dist")
    record |= {"renderer": "dist", "method": preset} if preset.endswith("_mask") else {"renderer": preset, "method": ""}
    record |= {"seed": config["seed"], "status": "ok", "reason": "", "config": config, "environment": MACHINE}
    record |= {
        "started": f"2025-03-01T{10 + minute // 60}:{minute % 60:02}:00+00:00",
        "metrics": {},
        "metrics_start": {},
    }
    record |= {"definitions": {}, "evaluations": {}, "seconds": {}, "peak_memory_bytes": None, "flops": None}
    record |= {"gemm_fraction": None, "reused": False, **changed}
    folder = results / "runs" / f"run{number:03}"
    folder.mkdir(parents=True)
    (folder / "record.json").write_text(json.dumps(record))
    return folder


def costs(queries: int = 1000, **changed) -> dict:
    """The metrics of an ablation run."""
    metrics = {
        "size": 64,
        "steps": 50,
        "queries": queries,
        "step_queries": 2 * queries,
        "step_gradients": 9,
        "repeats": 5,
    }
    for name, seconds in (("forward", 0.5), ("backward", 0.25), ("step", 0.75)):
        spread = {"": seconds, "_low": seconds - 0.125, "_high": seconds + 0.125}
        metrics |= {f"{name}_seconds{end}": value for end, value in spread.items()}
    metrics |= {"peak_memory_bytes": 123_000_000, "rays": 4096, "hits": 400, "lost": 12, "false": 8, "wrong": 3}
    return metrics | {"depth_error_median": 2e-5, "depth_error_p99": 1e-3, "depth_error_max": 0.25, **changed}


def write_images(folder: Path, size: int = 24, shift: float = 0.0, tilt: float = 0.0) -> None:
    """A ball: the row's is moved by `shift` in shares of the picture, its normals turned by `tilt` degrees."""
    reference, hit = ball(size, 0.0, 0.0)
    normals, found = ball(size, shift, tilt)
    arrays = {"normals": normals, "reference_normals": reference, "hit": found, "reference_hit": hit}
    np.savez(folder / "images.npz", **arrays, depth_error=np.zeros((size, size), np.float32))


def ball(size: int, shift: float, tilt: float) -> tuple[np.ndarray, np.ndarray]:
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2 - 1
    x = x - 2 * shift
    hit = x**2 + y**2 < 0.5
    z = np.sqrt(np.clip(0.5 - x**2 - y**2, 0, None))
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    normals = np.stack([c * x - s * z, y, s * x + c * z], -1) / np.sqrt(0.5)
    return np.where(hit[..., None], normals, 0).astype(np.float16), hit


def write_curve(folder: Path, losses: list[float], chamfers: dict[int, float], seconds: float = 0.5) -> None:
    lines = [
        {"iteration": i, "seconds": seconds * (i + 1), "value_evaluations": 10, "total": x}
        for i, x in enumerate(losses)
    ]
    for i, chamfer in chamfers.items():
        lines[i]["chamfer_l2"] = chamfer
    (folder / "curve.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def chosen(results: Path, name: str) -> Experiment | None:
    return choose(read_records(results)[0], PAGES[name].READS[0], results)


def told(made: tables.Result) -> str:
    """All that a page says in words: its caption, and the notes below it."""
    return " ".join([made.caption, *made.notes])


def table(results: Path, name: str = "table1") -> pd.DataFrame:
    return pd.read_csv(results / "paper" / f"{name}.csv", keep_default_na=False).set_index("row")


def test_old_records_and_other_experiments_are_ignored(tmp_path):
    folder = write_run(tmp_path, None, None)
    record = json.loads((folder / "record.json").read_text())
    del record["config"]["experiment"], record["config"]["label"]
    (folder / "record.json").write_text(json.dumps(record))
    assert chosen(tmp_path, "table1") is None
    write_run(tmp_path, "fig4", NAIVE)
    assert chosen(tmp_path, "fig4").names() == [NAIVE]


def test_newest_wins_and_a_row_keeps_its_place(tmp_path):
    write_run(tmp_path, "table1", "b", metrics=costs(1), minute=30)
    write_run(tmp_path, "table1", "a", metrics=costs(2), minute=20)
    write_run(tmp_path, "table1", "a", metrics=costs(3), minute=40)
    write_run(tmp_path, "table1", "c", metrics=costs(4), minute=35)
    records = chosen(tmp_path, "table1").records
    assert [(r["config"]["label"], r["metrics"]["queries"]) for r in records] == [("a", 3), ("b", 1), ("c", 4)]


@pytest.mark.parametrize(
    ("changed", "merged"),
    [
        ({"settings": {"view": {"resolution": 32}}}, False),
        ({"settings": {"dataset": {"name": "sofa"}}}, False),
        ({"environment": {**MACHINE, "threads": 4}}, True),
        ({"environment": {**MACHINE, "cpu": "Other CPU"}}, True),
        ({"environment": {**MACHINE, "commit": "abc"}}, True),
        ({"environment": {}, "status": "crashed"}, True),
        ({"settings": {"results_dir": "elsewhere", "verbose": True, "packages": ["mine"], "priors_dir": "p"}}, True),
        ({"settings": {"renderer": {"epsilon": 1e-3}, "seed": 5, "index": 2}, "renderer": "dvr"}, True),
    ],
)
def test_only_what_may_be_compared_is_merged(tmp_path, changed, merged):
    write_run(tmp_path, "table1", DYNAMIC, metrics=costs(), **changed)
    write_run(tmp_path, "table1", PARALLEL, metrics=costs())
    made = chosen(tmp_path, "table1")
    assert (len(made.records), made.left_out) == ((2, 0) if merged else (1, 1))
    assert ("Not shown: 1 run" in told(table1.make(made))) is not merged


@pytest.mark.parametrize("other", [{"threads": 8}, {"cpu": "Other CPU"}, {"device": "Some GPU"}])
def test_times_of_different_machines_are_not_compared_without_saying_so(tmp_path, other):
    write_run(tmp_path, "table1", NAIVE, metrics=costs(), environment={**MACHINE, **other})
    write_run(tmp_path, "table1", DYNAMIC, metrics=costs())
    write_run(tmp_path, "table1", PARALLEL, environment={}, status="crashed")
    made = chosen(tmp_path, "table1")
    assert made.names() == [NAIVE, DYNAMIC, PARALLEL]  # no planned row is lost for it
    result = table1.make(made)
    (warning,) = [note for note in result.notes if note.startswith("Times of rows from different machines")]
    (value,) = other.values()
    assert str(value) in warning
    assert f"({NAIVE})" in warning
    assert f"({DYNAMIC})" in warning
    assert "2 machines, see the notes" in result.caption


def test_a_run_with_other_settings_takes_no_row_from_one_that_has_its_label(tmp_path):
    write_run(tmp_path, "table1", DYNAMIC, metrics=costs(), settings={"renderer": {"steps": 50}})
    write_run(tmp_path, "table1", DYNAMIC, settings={"renderer": {"steps": 1}}, status="crashed", reason="no luck")
    assert chosen(tmp_path, "table1").names() == [f"{DYNAMIC} (steps 50)", f"{DYNAMIC} (steps 1)"]


def test_times_of_one_machine_are_compared_without_a_word(tmp_path):
    for row in (NAIVE, DYNAMIC):
        write_run(tmp_path, "table1", row, metrics=costs())
    assert "do not compare" not in told(table1.make(chosen(tmp_path, "table1")))


def test_times_of_a_loaded_machine_are_in_doubt(tmp_path):
    write_run(tmp_path, "table1", NAIVE, metrics=costs(), notes=["loaded machine: threads waited 31% of their time"])
    write_run(tmp_path, "table1", DYNAMIC, metrics=costs())
    assert f"Doubtful times, see the notes of the run: {NAIVE}." in table1.make(chosen(tmp_path, "table1")).notes


def test_table1_numbers_stand_in_their_rows_with_the_published_beside(tmp_path):
    write_run(tmp_path, "table1", "of ours", metrics=costs(5))
    write_run(tmp_path, "table1", DYNAMIC, metrics=costs(2_100_000))
    timed_out = {"status": "timeout", "reason": "64 pixels took over 60 s"}
    write_run(tmp_path, "table1", NAIVE, metrics=costs(6_100_000, size=32), **timed_out)
    write_run(tmp_path, "table1", PARALLEL, status="crashed", reason="no luck", environment={})
    main([f"results_dir={tmp_path}"])
    rows = table(tmp_path)
    assert list(rows.index) == [NAIVE, PARALLEL, DYNAMIC, "of ours"]  # the paper's order, then others
    assert list(rows["queries"]) == ["", "", "2100000", "5"]  # those of the asked size: as N/A in the paper
    assert list(rows["size"]) == [64, 64, 64, 64]
    assert list(rows["finished_queries"]) == ["6100000", "", "", ""]
    assert list(rows["finished_size"]) == ["32", "", "", ""]
    assert list(rows["published_queries"]) == ["N/A", "6.06M", "1.99M", ""]
    assert list(rows["published_time"]) == ["N/A", "3.39s", "1.23s", ""]
    assert list(rows["published_steps"]) == ["50", "50", "50", ""]
    assert list(rows["status"]) == ["timeout", "crashed", "ok", "ok"]
    assert list(rows["reason"]) == ["64 pixels took over 60 s", "no luck", "", ""]
    row = rows.loc[DYNAMIC]
    shown = (
        "forward_s",
        "backward_s",
        "step_s",
        "step_s_low",
        "step_s_high",
        "lost",
        "false",
        "wrong",
        "depth_error_max",
    )
    assert [float(row[name]) for name in shown] == [0.5, 0.25, 0.75, 0.625, 0.875, 12, 8, 3, 0.25]


def test_table1_says_to_a_reader_what_failed_and_how_it_was_measured(tmp_path):
    write_run(tmp_path, "table1", DYNAMIC, metrics=costs(), definitions={"queries": "Field values."})
    write_run(tmp_path, "table1", NAIVE, metrics=costs(size=32), status="timeout", reason="over 60 s")
    write_run(tmp_path, "table1", PARALLEL, status="crashed", reason="no luck")
    made = table1.make(chosen(tmp_path, "table1"))
    assert list(made.table["Size"]) == ["32 (64: timeout)", "– (64: crashed)", "64"]
    assert made.table["Step"].iloc[2] == "750 ms (625–875)"
    assert made.table["Missed / spurious / wrong depth"].iloc[2] == "12 / 8 / 3"
    for words in ("car 0", "64×64 pixels", "4 layers of 128", "Some CPU", "2 threads", "5 repeats", "n = 3 runs"):
        assert words in made.caption
    assert "GTX 1080Ti" in told(made)
    assert "2 of 3 runs did not end ok: Naive sphere tracing: timeout (over 60 s); + parallel: crashed" in made.caption
    assert [note for note in made.notes if note.endswith("Field values.")] == ["Queries: Field values."]


def test_rows_of_several_seeds_and_shapes_are_told_apart(tmp_path):
    for settings in ({"seed": 0}, {"seed": 1}):
        write_run(tmp_path, "table1", DYNAMIC, metrics=costs(), settings=settings)
    assert list(table1.make(chosen(tmp_path, "table1")).table["Strategy"]) == ["+ dynamic, seed 0", "+ dynamic, seed 1"]


def test_hostile_words_are_escaped_everywhere(tmp_path):
    hostile = r"50 % of a_b & #1 {x} \input | ~^ $" + HOSTILE
    write_run(tmp_path, "table1", hostile, metrics=costs(), status="crashed", reason=hostile)
    main([f"results_dir={tmp_path}"])
    text = (tmp_path / "paper" / "table1.tex").read_text()
    row = text[text.index(r"\midrule") : text.index(r"\bottomrule")]
    assert r"50 \% of a\_b \& \#1 \{x\} \textbackslash{}input \textbar{} \textasciitilde{}\textasciicircum{} \$" in row
    assert r"\textless{}script\textgreater{}" in row
    assert row.replace(r"\&", "").count("&") == 12 and row.count(r"\\") == 1  # the 13 cells of one row
    shown = next(paper.shown for paper in find_paper(tmp_path) if paper.name == "table1")
    assert shown.rows[0][0] == hostile and len(shown.rows[0]) == len(shown.columns) == 13
    assert Page(tmp_path).paper("table1")["rows"][0][0] == hostile  # reading it checks that no script can come of it


def test_latex_is_one_plain_booktabs_table(tmp_path):
    write_run(tmp_path, "table1", DYNAMIC, metrics=costs(depth_error_max="inf"))
    text = tables.latex(table1.make(chosen(tmp_path, "table1")).shown(), "table1")
    for rule in (r"\toprule", r"\midrule", r"\bottomrule", r"\begin{tabular}", r"\end{table*}"):
        assert text.count(rule) == 1
    assert r"$\infty$" in text and r"64$\times$64" in text
    assert text.isascii()


def bands(factor: float = 1.0, camera: bool = True) -> dict:
    """The metrics of a gradients run."""
    metrics = {"silhouette.pixels": 77, "silhouette.image_cosine": 0.75, "silhouette.image_scale": 0.5 * factor}
    for place, band in enumerate(("frontal", "oblique", "grazing"), start=1):
        metrics |= {f"{band}.pixels": 100 * place, f"{band}.excluded": place}
        for of in ("code", "camera")[: 1 + camera]:
            numbers = {
                "cosine": 1.0,
                "pooled_cosine": 1 - 0.01 * place,
                "pooled_scale": 1.25 * factor,
                "scale": factor * place,
                "median_error": 1e-4 * place,
                "p99_error": 0.1,
            }
            metrics |= {f"{band}.{of}_{name}": value for name, value in numbers.items()}
    return metrics


def write_judged(results: Path) -> Path:
    """Writes three runs of the gradients' table, one of which failed."""
    definitions = {"code_cosine, camera_cosine": "Of both.", "else": "?", "frontal.pixels": "Drawn."}
    write_run(results, "gradients", None, metrics=bands(), renderer="dist", definitions=definitions)
    write_run(results, "gradients", None, metrics=bands(2.0, camera=False), renderer="dvr")
    write_run(results, "gradients", None, renderer="naive", status="oom", reason="8 GB")
    return results


@pytest.fixture
def judged(tmp_path: Path) -> Path:
    return write_judged(tmp_path)


def test_gradients_have_a_row_for_each_renderer_and_band(reported):
    rows = pd.read_csv(reported / "paper" / "gradients.csv").set_index(["row", "band"])
    assert list(rows.index) == [(name, band) for name in ("dist", "dvr", "naive") for band in gradients.BANDS]
    assert rows.loc[("dvr", "oblique"), "code_scale"] == 4.0
    assert rows.loc[("dist", "grazing"), "camera_median_error"] == pytest.approx(3e-4)
    assert np.isnan(rows.loc[("dvr", "frontal"), "camera_scale"])
    assert rows.loc[("dist", "silhouette"), "image_cosine"] == 0.75
    assert rows.loc[("dist", "silhouette"), "pixels"] == 77
    assert (rows.loc["naive", "status"] == "oom").all() and rows.loc["naive", "code_scale"].isna().all()
    text = (reported / "paper" / "gradients.md").read_text()
    assert (
        "- Code cosine, Camera cosine: Of both.\n- Pixels: Drawn.\n" in text
        and "naive: oom (8 GB)" in text
        and "gradients.png" in text
    )
    assert "Code pooled cosine | Code pooled scale | Code cosine" in text
    assert "A pooled number compares the gradients of all pixels of a band at once" in text
    assert rows.loc[("dist", "grazing"), "code_pooled_cosine"] == 0.97
    assert r"\begin{tabular}" in (reported / "paper" / "gradients.tex").read_text()


def seen(blur: str, error: float) -> dict[str, float]:
    """The metrics at the outline, at a blur."""
    numbers = {"image_cosine": 0.9, "image_scale": 1.1, "image_error": error, "image_spread": 2.0}
    return {f"silhouette_{blur}.{name}": value for name, value in (numbers | {"values_per_ray": 30.0}).items()}


def test_what_comes_into_view_has_a_row_for_each_blur(tmp_path):
    blurred = seen("1e-03", 0.3) | seen("3e-02", 0.2)
    own = {key.replace("_1e-03", ""): value for key, value in seen("1e-03", 0.9).items()}
    write_run(tmp_path, "gradients", None, metrics=bands() | own, renderer="idr")
    write_run(tmp_path, "gradients", None, metrics=bands() | own | blurred, renderer="neus")
    write_run(tmp_path, "gradients", None, renderer="naive", status="oom", reason="8 GB")
    main([f"results_dir={tmp_path}"])
    rows = pd.read_csv(tmp_path / "paper" / "gradients_visibility.csv").set_index("row")
    assert rows.loc["neus", "blur"].tolist() == [0.001, 0.03]
    assert rows.loc["neus", "image_error"].tolist() == [0.3, 0.2]
    assert rows.loc["idr", "image_error"] == 0.9 and np.isnan(rows.loc["idr", "blur"])
    assert rows.loc["naive", "status"] == "oom"
    figure = gradients_visibility.draw(
        rows.reset_index().assign(
            name=lambda r: r["row"],
            preset=lambda r: r["row"],
            blur=lambda r: r["blur"].map("{:g}".format).replace("nan", ""),
        )
    )
    by_blur, _, by_cost = figure.axes
    drawn_lines = [list(line.get_ydata()) for line in by_blur.lines if len(line.get_ydata())]
    assert sorted(drawn_lines) == [[0.3, 0.2], [0.9, 0.9]]
    assert {line.get_label() for line in by_cost.lines} >= {"neus"}


def drawn(axis, label: str) -> list[float]:
    line = next(line for line in axis.lines if line.get_label() == label)
    return [float(y) for y in line.get_ydata()]


def test_gradients_figure_plots_the_numbers_of_its_csv(judged):
    made = gradients.make(chosen(judged, "gradients"))
    axes = made.figure.axes
    own = made.data[made.data["row"] == "dvr"].set_index("band").loc[["frontal", "oblique", "grazing"]]
    assert drawn(axes[0], "dvr") == list(own["code_pooled_cosine"]) == [0.99, 0.98, 0.97]
    assert drawn(axes[3], "dvr") == list(own["code_scale"]) == [2.0, 4.0, 6.0]
    assert drawn(axes[6], "dvr") == list(own["code_median_error"])
    assert (drawn(axes[2], "dvr"), drawn(axes[5], "dvr")) == ([0.75], [1.0])
    assert axes[6].get_yscale() == axes[7].get_yscale() == "log"
    assert not axes[8].get_visible()
    assert "naive (oom)" in [line.get_label() for line in axes[0].lines]
    assert_labelled(made.figure, x_labels=False)


def assert_labelled(figure, x_labels: bool = True) -> None:
    """Axes that have numbers say of what, with a unit or why there is none."""
    charts = [axis for axis in figure.axes if axis.axison and axis.lines]
    assert charts
    for axis in charts:
        assert axis.get_ylabel() and (axis.get_xlabel() or not x_labels)


def test_fig4_counts_what_the_pictures_show(tmp_path):
    write_images(write_run(tmp_path, "fig4", PARALLEL))
    write_images(write_run(tmp_path, "fig4", DYNAMIC), shift=0.1, tilt=10.0)
    write_images(write_run(tmp_path, "fig4", NAIVE, status="timeout", reason="slow"), size=8)
    write_run(tmp_path, "fig4", "+ aggressive")
    made = fig4.make(chosen(tmp_path, "fig4"))
    rows = made.data.set_index("row")
    assert list(rows.index) == [PARALLEL, DYNAMIC, NAIVE, "+ aggressive"]
    assert list(rows["size"]) == [24, 24, 8, None]
    assert (rows.loc[PARALLEL, "lost"], rows.loc[PARALLEL, "false"], rows.loc[PARALLEL, "angle_max"]) == (0, 0, 0)
    reference, moved = ball(24, 0.0, 0.0)[1], ball(24, 0.1, 0.0)[1]
    assert rows.loc[DYNAMIC, "lost"] == (reference & ~moved).sum() > 0
    assert rows.loc[DYNAMIC, "false"] == (moved & ~reference).sum() > 0
    assert rows.loc[DYNAMIC, "hits"] == reference.sum()
    assert "No pictures of 1 run: no images.npz." in made.notes
    titles = [label.get_text().replace("\n", " ") for label in made.figure.axes[0].get_xticklabels()]
    assert titles == ["reference", PARALLEL, DYNAMIC, f"{NAIVE}, 8 px", "+ aggressive"]
    assert [text.get_text() for text in made.figure.axes[0].texts if text.get_text()] == ["timeout", "no picture"]
    assert any("degrees" in axis.get_ylabel() for axis in made.figure.axes)


def test_angles_are_degrees_where_both_hit(tmp_path):
    write_images(tmp_path, tilt=10.0)
    images = gallery.arrays(tmp_path, gallery.REFERENCE)[0]
    angles = gallery.angles(images)
    assert np.isnan(angles).sum() == (~images["hit"]).sum()
    within = np.abs(images["normals"][..., 1]) < 0.1  # the turn is about y
    assert np.nanmedian(angles[within]) == pytest.approx(10.0, abs=0.2)


def test_lost_and_false_pixels_have_their_colours(tmp_path):
    write_images(write_run(tmp_path, "fig4", DYNAMIC), shift=0.1)
    made = fig4.make(chosen(tmp_path, "fig4"))
    images = gallery.arrays(tmp_path / "runs" / "run000", gallery.REFERENCE)[0]
    shown = made.figure.axes[0].get_images()[-1].get_array()
    for colour, mask, other in ((style.MISSED, "reference_hit", "hit"), (style.SPURIOUS, "hit", "reference_hit")):
        wrong = images[mask] & ~images[other]
        assert wrong.any() and ((shown == to_rgb(colour)).all(-1) == wrong).all()


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "cannot be read"),
        (b"PK\x03\x04 not a zip", "cannot be read"),
        ({"hit": np.ones((2, 2))}, "lacks an array"),
        ({name: np.ones((2, 2 + place)) for place, name in enumerate(gallery.REFERENCE)}, "different sizes"),
    ],
)
def test_broken_pictures_are_a_remark(tmp_path, content, why):
    path = write_run(tmp_path, "fig4", DYNAMIC) / "images.npz"
    path.write_bytes(content) if isinstance(content, bytes) else np.savez(path, **content)
    made = fig4.make(chosen(tmp_path, "fig4"))
    assert why in told(made) and list(made.data["lost"]) == [None]


@pytest.fixture
def thresholds(tmp_path: Path) -> Path:
    for epsilon, lost, false in ((5e-5, 0, 1), (5e-2, 4, 100), (5e-7, 40, 0)):
        metrics = costs(lost=lost, false=false, depth_error_median=epsilon / 2)
        write_images(write_run(tmp_path, "fig7", None, metrics=metrics, settings={"renderer": {"epsilon": epsilon}}))
    settings = {"renderer": {"epsilon": 5e-3}}
    write_run(tmp_path, "fig7", None, settings=settings, status="killed", reason="stopped", environment={})
    return tmp_path


def test_fig7_is_in_order_of_epsilon_and_plots_the_shares(thresholds):
    made = fig7.make(chosen(thresholds, "fig7"))
    assert list(made.data["epsilon"]) == [5e-2, 5e-3, 5e-5, 5e-7]
    assert list(made.data["lost_share"]) == [0.01, None, 0.0, 0.1]
    assert list(made.data["false_share"]) == [0.25, None, 0.0025, 0.0]
    assert list(made.data["status"]) == ["ok", "killed", "ok", "ok"]
    charts = {axis.get_ylabel(): axis for figure in made.figure.subfigs for axis in figure.axes}
    shares, depth = charts["pixels (% of the reference's hits)"], charts["median depth error (scene units)"]
    assert drawn(shares, "erosion") == pytest.approx([1.0, np.nan, 0.0, 10.0], nan_ok=True)
    assert drawn(shares, "dilation") == pytest.approx([25.0, np.nan, 0.25, 0.0], nan_ok=True)
    assert drawn(depth, "dist") == pytest.approx([2.5e-2, np.nan, 2.5e-5, 2.5e-7], nan_ok=True)
    assert shares.get_xscale() == depth.get_xscale() == "log"
    assert_labelled(made.figure.subfigs[1])
    assert "killed (stopped)" in made.caption


def test_pictures_are_of_one_scene(tmp_path):
    write_images(write_run(tmp_path, "fig7", None, settings={"index": 1}))
    write_images(write_run(tmp_path, "fig7", None, settings={"index": 0}))
    made = fig7.make(chosen(tmp_path, "fig7"))
    assert list(made.data["index"]) == [0] and "Not shown: 1 run" in told(made)


@pytest.fixture
def completions(tmp_path: Path) -> Path:
    write_curve(write_run(tmp_path, "fig5", PARALLEL), [4, 3, 2, 1], {0: 0.4, 2: 0.1, 3: 0.2})
    write_curve(write_run(tmp_path, "fig5", DYNAMIC), [8, 6, 4, 2], {0: 0.4, 2: 0.2, 3: 0.1}, seconds=0.25)
    write_curve(write_run(tmp_path, "fig5", DYNAMIC, settings={"seed": 1}), [6, 4, 2, 1], {0: 0.2, 2: 0.1, 3: 0.05})
    folder = write_run(tmp_path, "fig5", DYNAMIC, settings={"seed": 2}, status="diverged", reason="loss rose")
    write_curve(folder, [5, 9], {0: 0.3})
    write_run(tmp_path, "fig5", "+ aggressive", status="crashed", reason="early")
    return tmp_path


@pytest.mark.parametrize(
    ("task", "said"),
    [
        (
            {"normal_weight": 1.0, "normal_width": 0.02},
            "depths, normals over 0.02 scene units (weight 1) and the silhou",
        ),
        ({"normal_weight": 0.0, "normal_width": 0.02}, "The loss has depths and the silhouette; the paper's Fig. 5"),
        ({}, "The loss has depths and the silhouette; the paper's Fig. 5"),  # of older runs
    ],
)
def test_fig5_says_whether_its_loss_has_normals(tmp_path, task, said):
    write_curve(write_run(tmp_path, "fig5", PARALLEL, settings={"task": task}), [4, 3, 2, 1], {0: 0.4, 2: 0.1, 3: 0.2})
    assert said in told(fig5.make(chosen(tmp_path, "fig5")))


@pytest.mark.parametrize(
    ("silhouette", "said"),
    [
        ({"_label_": "DIST's mask loss"}, "it is the same for every row"),
        ({}, "losses of different rows do not compare"),
    ],
)
def test_fig5_says_whether_losses_can_be_compared(tmp_path, silhouette, said):
    settings = {"silhouette": silhouette}
    write_curve(write_run(tmp_path, "fig5", PARALLEL, settings=settings), [4, 3, 2, 1], {0: 0.4, 2: 0.1, 3: 0.2})
    assert said in told(fig5.make(chosen(tmp_path, "fig5")))


def test_fig5_data_holds_runs_medians_and_correlation(completions):
    data = fig5.make(chosen(completions, "fig5")).data
    runs = data[(data["kind"] == "run") & (data["row"] == PARALLEL)]
    assert list(runs["total"]) == [4, 3, 2, 1] and list(runs["seconds"]) == [0.5, 1.0, 1.5, 2.0]
    failed = data[(data["kind"] == "run") & (data["row"] == "+ aggressive")]
    assert list(failed["status"]) == ["crashed"] and list(failed["reason"]) == ["early"]
    medians = data[(data["kind"] == "median") & (data["row"] == DYNAMIC)].dropna(subset="total")
    assert list(medians["total"]) == [6, 6, 4, 2]  # the diverged run counts as infinite from its third iteration on
    assert list(medians["n"]) == [3] * 4
    rho = data[data["kind"] == "correlation"].set_index("row")
    assert rho.loc[PARALLEL, "spearman"] == pytest.approx(0.5) and rho.loc[PARALLEL, "n"] == 3
    assert rho.loc["+ aggressive", "spearman"] is None and rho.loc["+ aggressive", "n"] == 0


def test_fig5_plots_the_numbers_of_its_csv(completions):
    made = fig5.make(chosen(completions, "fig5"))
    medians = made.data[(made.data["kind"] == "median") & (made.data["row"] == PARALLEL)]
    loss, chamfer = (medians.dropna(subset=name) for name in ("total", "chamfer_l2"))
    axes = made.figure.axes
    assert list(axes[0].lines[0].get_ydata()) == list(loss["total"])
    assert list(axes[1].lines[0].get_xdata()) == list(loss["seconds"])
    assert list(axes[2].lines[0].get_xdata()) == list(chamfer["iteration"]) == [0, 2, 3]
    assert list(axes[2].lines[0].get_ydata()) == pytest.approx([1000 * x for x in chamfer["chamfer_l2"]])
    assert "× 1000" in axes[2].get_ylabel()
    line = made.table.set_index("Method").loc[PARALLEL]
    assert (line["End"], line["ρ"], line["of"]) == ("200", "0.500", "3")
    assert_labelled(made.figure)
    for words in ("no curve.jsonl", "infinite"):
        assert words in told(made)
    for words in ("2 of 5 runs did not end ok", "diverged (loss rose)", "n = 5 runs (1 shape, 3 seeds)"):
        assert words in made.caption


def test_curve_with_broken_lines_is_read_as_far_as_it_goes(tmp_path):
    text = '{"iteration": 0, "seconds": 1, "total": "inf"}\n[1]\n{"iteration": 1, "sec'
    (tmp_path / "curve.jsonl").write_text(text)
    curve, remark = curves.read(tmp_path)
    assert list(curve["total"]) == [float("inf")] and remark == "2 lines of curve.jsonl cannot be read"


@pytest.mark.parametrize("name", ["table1", "fig4", "fig5", "fig7", "gradients"])
def test_experiment_of_nothing_but_failures_is_still_made(tmp_path, name):
    write_run(tmp_path, name, NAIVE, status="crashed", reason="early", environment={}, settings={"renderer": None})
    main([f"results_dir={tmp_path}"])
    rows = table(tmp_path, name)
    assert set(rows.index) == {NAIVE} and "crashed" in set(rows["status"])
    assert "The run did not end ok" in (tmp_path / "paper" / f"{name}.md").read_text()


def test_command_writes_all_files_and_the_page_shows_them(reported):
    drawn_too = {".csv", ".md", ".tex", ".json", ".png", ".pdf"}
    suffixes = {"table1": {".csv", ".md", ".tex", ".json"}, "gradients": drawn_too, "gradients_visibility": drawn_too}
    written = {path.name for path in (reported / "paper").iterdir()}
    assert written == {name + suffix for name, them in suffixes.items() for suffix in them}
    page = Page(reported)
    assert links(page) == {f"paper/{name}" for name in written if not name.endswith(".json")}
    assert "1.99M" in page.paper("table1")["rows"][0]
    assert [paper["name"] for paper in page.papers] == ["table1", "gradients", "gradients_visibility"]
    assert (reported / "paper" / "gradients.png").read_bytes()[:4] == b"\x89PNG"


def test_page_alone_makes_nothing_and_shows_what_is_there(judged):
    write_index(judged)
    assert not (judged / "paper").exists()
    (judged / "paper").mkdir()
    for name in ("mine 1.png", "table1.csv", ".hidden.md", "damaged.md"):
        (judged / "paper" / name).write_bytes(b"\xff|\n\n|\n")
    write_index(judged)
    assert links(Page(judged)) == {"paper/mine%201.png", "paper/table1.csv", "paper/damaged.md"}


def links(page: Page) -> set[str]:
    """The addresses of all files of tables and figures."""
    found = [page.paper(paper["name"]) for paper in page.papers]
    return {link for whole in found for link in [*whole["files"].values(), whole["picture"]] if link}


def test_same_records_give_the_same_files(reported, tmp_path, capsys):
    copy = shutil.copytree(reported, tmp_path / "results")
    main([f"results_dir={copy}"])
    assert capsys.readouterr().out.splitlines()[-1] == str(copy / "index.html")
    first, second = ({path.name: path.read_bytes() for path in (each / "paper").iterdir()} for each in (reported, copy))
    assert first == second


def test_row_keeps_its_look_and_known_rows_differ():
    assert style.look("some new strategy") == style.look("some new strategy")
    strategies = [style.look(preset) for preset in table1.PUBLISHED]
    assert len({look.colour for look in strategies}) == len({look.marker for look in strategies}) == 7


def test_drawing_leaves_the_settings_of_matplotlib_alone(judged):
    import matplotlib

    before = dict(matplotlib.rcParams)
    gradients.make(chosen(judged, "gradients"))
    assert dict(matplotlib.rcParams) == before
