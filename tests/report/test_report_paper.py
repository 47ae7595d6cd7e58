"""The tables and figures of the experiments, made from run folders whose numbers are known."""

import html
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from bench.pictures import figure_style
from bench.records.read import read_records
from bench.report.__main__ import main
from bench.report.data import curves
from bench.report.data.runs import Runs, choose
from bench.report.study import published
from bench.report.write.html import write_index
from bench.report.write.paper import find_paper, studies
from bench.report.write.result import Result, Shown, as_markdown, latex
from bench.studies import fig4, fig5, fig7, gradients, table1
from tests.looped import each
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

    `changed` are fields of the record; `settings` those of its configuration, where `index`, `seed` and the name of the
    dataset stand as well; `minute` when it started. The label's preset is the renderer's, or, where it is a method, the
    method's.
    """
    number = len(list((results / "runs").glob("*")))
    settings, minute = changed.pop("settings", {}), changed.pop("minute", number)
    task = {"fig5": "completion", "gradients": "gradients"}.get(experiment or "", "ablation")
    config = {"experiment": experiment, "label": label, "index": changed.pop("index", 0), "view": {"resolution": 64}}
    config |= {"seed": changed.get("seed", 0), "dataset": {"name": changed.get("dataset", "car")}}
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
    metrics |= {
        "peak_memory_bytes": 123_000_000,
        "rays": 4096,
        "hits": 400,
        "lost": 12,
        "false": 8,
        "wrong": 3,
        "behind": 0.2,
    }
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


def write_lines(folder: Path, lines: list[dict]) -> None:
    """Writes the curve of a run."""
    (folder / "curve.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def write_curve(folder: Path, losses: list[float], chamfers: dict[int, float], seconds: float = 0.5) -> None:
    """Writes a curve with these losses, and errors of some iterations; an iteration computes 100 field values."""
    lines = [
        {"iteration": i, "seconds": seconds * (i + 1), "value_evaluations": 100 * (i + 1), "total": x}
        for i, x in enumerate(losses)
    ]
    for i, chamfer in chamfers.items():
        lines[i]["chamfer_l2"] = chamfer
    write_lines(folder, lines)


def chosen(results: Path, name: str) -> Runs | None:
    return choose(read_records(results)[0], PAGES[name].READS[0], results)


def page_of(results: Path, name: str) -> Result:
    """A page as it is made of the runs of a results folder."""
    records, study = read_records(results)[0], next(study for study in studies() if name in study.pages)
    return study.pages[name](*(choose(records, selection, results) for selection in study.reads))


def told(made: Result) -> str:
    """All that a page says in words: its caption, and the notes below it."""
    return " ".join([made.caption, *made.notes])


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


@each(
    "changed, merged",
    [
        ({"settings": {"view": {"resolution": 32}}}, False),
        ({"settings": {"dataset": {"name": "sofa"}}}, False),
        ({"environment": {**MACHINE, "threads": 4}}, True),
        ({"environment": {}, "status": "crashed"}, True),
        ({"settings": {"results_dir": "elsewhere", "verbose": True, "packages": ["mine"], "priors_dir": "p"}}, True),
        ({"settings": {"renderer": {"epsilon": 1e-3}, "seed": 5, "index": 2}, "renderer": "dvr"}, True),
    ],
)
def test_only_what_may_be_compared_is_merged(tmp_path_factory, changed, merged):
    results = tmp_path_factory.mktemp("results")
    write_run(results, "table1", DYNAMIC, metrics=costs(), **changed)
    write_run(results, "table1", PARALLEL, metrics=costs())
    made = chosen(results, "table1")
    assert (len(made.records), made.left_out.total()) == ((2, 0) if merged else (1, 1))
    assert ("Not shown: 1 run" in told(table1.make(made, None))) is not merged


@each("other", [{"threads": 8}, {"cpu": "Other CPU"}, {"device": "Some GPU"}, {"kernels": "compiled"}])
def test_times_of_different_machines_are_not_compared_without_saying_so(tmp_path_factory, other):
    results = tmp_path_factory.mktemp("results")
    write_run(results, "table1", DYNAMIC, metrics=costs())
    write_run(results, "table1", PARALLEL, environment={"waited_share": 0.1}, status="killed")
    assert "Do not compare times" not in told(page_of(results, "table1"))
    write_run(results, "table1", NAIVE, metrics=costs(), environment={**MACHINE, **other})
    made = chosen(results, "table1")
    assert made.names() == [DYNAMIC, PARALLEL, NAIVE]  # no planned row is lost for it
    result = table1.make(made, None)
    (warning,) = [note for note in result.notes if note.startswith("Do not compare times of different machines")]
    assert all(words in warning for words in (*map(str, other.values()), f": {NAIVE}", f": {DYNAMIC}"))
    assert "2 machines, see the notes" in result.caption


def test_a_run_with_other_settings_takes_no_row_from_one_that_has_its_label(tmp_path):
    write_run(tmp_path, "table1", DYNAMIC, metrics=costs(), settings={"renderer": {"steps": 50}})
    write_run(tmp_path, "table1", DYNAMIC, settings={"renderer": {"steps": 1}}, status="crashed", reason="no luck")
    assert chosen(tmp_path, "table1").names() == [f"{DYNAMIC} (steps 50)", f"{DYNAMIC} (steps 1)"]


def test_table_1_says_what_a_strategy_saves_and_has_the_published_numbers_at_their_size(tmp_path):
    for number, (size, experiment) in enumerate({64: "table1", 512: "table1_large"}.items()):
        for label, seconds in ((PARALLEL, 3.0), (DYNAMIC, 1.5)):
            settings = {"view": {"resolution": size}}
            about = {"metrics": costs(size=size, step_seconds=seconds), "settings": settings, "minute": 10 * number}
            write_run(tmp_path, experiment, label, **about)
    page = page_of(tmp_path, "table1")
    assert page.verdict.startswith("A step at 64 pixels takes ") and f"{DYNAMIC} *2.0×*" in page.verdict
    published = next(column for column in page.columns if column.heading == "Published evaluations")
    assert [published.words(line) for line in page.lines] == ["", "", "6.06M", "1.99M"]


def test_a_strategy_whose_forerunner_is_missing_is_not_credited_with_what_both_save(tmp_path):
    for label, seconds in ((NAIVE, 9.0), (DYNAMIC, 1.5)):
        write_run(tmp_path, "table1", label, metrics=costs(step_seconds=seconds))
    assert "speedup" not in page_of(tmp_path, "table1").verdict


def test_times_of_a_loaded_machine_are_in_doubt(tmp_path):
    write_run(tmp_path, "table1", NAIVE, metrics=costs(), notes=["loaded machine: threads waited 31% of their time"])
    for label in (DYNAMIC, PARALLEL):
        write_run(tmp_path, "table1", label, metrics=costs())
    page = page_of(tmp_path, "table1")
    assert f"Times are not reliable, see the notes of the runs: {NAIVE}." in page.notes and "Forward" in page.table
    write_run(tmp_path, "table1", DYNAMIC, metrics=costs(), notes=["loaded machine: it waited"])
    page = page_of(tmp_path, "table1")
    assert any(note.startswith("No runtimes, since the machine had load: ") for note in page.notes)
    assert "Forward" not in page.table and page.data["forward_s"].notna().all()


def test_hostile_words_are_escaped_everywhere(tmp_path):
    hostile = r"[50 % of a_b & #1 {x} \input | ~^ $" + HOSTILE
    odd = costs(depth_error_max="inf")
    write_run(tmp_path, "table1", hostile, metrics=odd, status="crashed", reason=hostile)
    main([f"results_dir={tmp_path}"])
    text = (tmp_path / "paper" / "table1.tex").read_text()
    assert r"\begin{tabular}{>{\raggedright\arraybackslash}p{0.4\textwidth}" in text
    row = text[text.index(r"\midrule") : text.index(r"\bottomrule")]
    assert (
        r"{[}50 \% of a\_b \& \#1 \{x\} \textbackslash{}input \textbar{} \textasciitilde{}\textasciicircum{} \$" in row
    )
    assert r"\textless{}script\textgreater{}" in row
    assert row.replace(r"\&", "").count("&") == 12 and row.count(r"\\") == 1  # the 13 cells of one row
    assert r"$\infty$" in row and r"64$\times$64" in text and text.isascii()
    shown = next(paper.shown for paper in find_paper(tmp_path) if paper.name == "table1")
    assert shown.rows[0][0] == hostile and len(shown.rows[0]) == len(shown.columns) == 13
    assert Page(tmp_path).paper("table1")["rows"][0][0] == hostile  # reading it checks that no script can come of it


SIGNS = r"""[a](b) @ ![a](b) @ [a]: b @ [a][b] @ [a] [b] @ a ]( b [ @ \[a](b) @ [[a](b)] @ [x] a @ `[a](b)` @ `a|b` c `
@ a | b @ a < b &lt; <a href=b>c</a> <http://a.b> @ *a* **b** @ a\ @ `a

<b>`"""


@each("text", SIGNS.split("@"))
def test_markdown_shows_text_without_links_images_and_html(text):
    """In each part of a page, by a reader of CommonMark with tables."""
    reader = pytest.importorskip("markdown_it").MarkdownIt("commonmark").enable("table")
    escaped = as_markdown(text)
    for part in ("a {} b", "- {}", "**{}**", "| {} | b |\n| --- | --- |\n| {} | [c](d) |\n"):
        page = reader.render(part.replace("{}", escaped))
        expected = reader.render(part.replace("{}", "TEXT")).replace("TEXT", html.escape(" ".join(text.split())))
        assert page == expected


def test_markdown_of_intervals_and_code_is_not_escaped():
    assert as_markdown("0.5 [0.2, 0.7] and `not_reached` & a_b") == "0.5 [0.2, 0.7] and `not_reached` & a_b"


def test_latex_has_one_sentence_powers_of_ten_dashes_and_rules_between_groups():
    rows = [["sofa", "a_b", "2.2e-5"], ["sofa", "50 %", "[-1e-7, 1e+6]"], ["car", "96³", ""], ["car", "id3e5x", "N/A"]]
    page = Shown(title="Errors.", caption="Of 3e5 rays. n = 4 runs.", columns=["Family", "Row", "Error"], rows=rows)
    head, text = latex(page, "mine").split(r"\begin{table*}")
    assert all(line.startswith("% ") for line in head.splitlines()) and "n = 4 runs." in head
    assert r"\caption{Errors.}" in text and text.isascii()
    assert text[text.index(r"\midrule") : text.index(r"\bottomrule")].splitlines() == [
        *(r"\midrule", r"sofa & a\_b & $2.2\times10^{-5}$ \\", r" & 50 \% & {[}$-1\times10^{-7}$, $1\times10^{6}$] \\"),
        *(r"\midrule", r"car & 96$^3$ & -- \\", r" & id3e5x & -- \\"),
    ]
    apart, second = (latex(page.narrowed(names), "mine") for names in (["Error", "Row"], ["Row", "Family"]))
    assert apart.count(r"\midrule") == 1 and r"$2.2\times10^{-5}$ & a\_b \\" in apart
    assert second.count(r"\midrule") == 2 and "\\midrule\n96$^3$ & car \\\\\nid3e5x & car" in second


def test_columns_of_a_latex_table_are_chosen_by_their_headings(reported, tmp_path, capsys):
    copy = shutil.copytree(reported, tmp_path / "results")
    before = {path.name: path.read_bytes() for path in (copy / "paper").iterdir()}
    assert main([f"results_dir={copy}", 'columns.table1="Field evaluations", Strategy']) == 0
    text = (copy / "paper" / "table1.tex").read_text()
    assert "ions\\end{tabular} & Strategy \\\\\n\\midrule\n1.00k & + dynamic \\\\\n\\bottomrule" in text
    changed = {path.name for path in (copy / "paper").iterdir() if path.read_bytes() != before[path.name]}
    assert changed == {"table1.tex"}
    for argument, named in (
        ("columns.table1=Strategy,Quers", "columns.table1: no column 'Quers'; choose from Strategy,"),
        ("columns.tabel1=Step", "columns.tabel1: no table of that name; there are table1, gradients, "),
    ):
        capsys.readouterr()
        assert main([f"results_dir={copy}", argument]) == 2
        assert named in capsys.readouterr().err


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


def drawn(axis, label: str, letter: str = "y") -> list[float]:
    """The values of the line with a label, along an axis."""
    line = next(line for line in axis.lines if line.get_label() == label)
    return [float(value) for value in getattr(line, f"get_{letter}data")()]


@pytest.fixture
def completions(tmp_path: Path) -> Path:
    write_curve(write_run(tmp_path, "fig5", PARALLEL), [4, 3, 2, 1], {0: 0.4, 2: 0.1, 3: 0.2})
    write_curve(write_run(tmp_path, "fig5", DYNAMIC), [8, 6, 4, 2], {0: 0.4, 2: 0.2, 3: 0.1}, seconds=0.25)
    write_curve(write_run(tmp_path, "fig5", DYNAMIC, settings={"seed": 1}), [6, 4, 2, 1], {0: 0.2, 2: 0.1, 3: 0.05})
    folder = write_run(tmp_path, "fig5", DYNAMIC, settings={"seed": 2}, status="diverged", reason="loss rose")
    write_curve(folder, [5, 9], {0: 0.3})
    write_run(tmp_path, "fig5", "+ aggressive", status="crashed", reason="early")
    return tmp_path


def test_fig5_says_which_terms_its_loss_has_and_whether_losses_can_be_compared(tmp_path):
    alone = "The loss has terms for depths and the silhouette; DIST, Fig. 5"
    for task, label, words in (
        (
            {"normal_weight": 1.0, "normal_width": 0.02},
            "hinge",
            ["normals over 0.02 scene units (weight 1)", "all rows share it"],
        ),
        ({"normal_weight": 0.0, "normal_width": 0.02}, "", [alone, "losses of different rows cannot be compared"]),
        ({}, "", [alone]),  # of older runs
    ):
        settings = {"task": task, "silhouette": {"_label_": label} if label else {}}
        results = tmp_path / str(len(list(tmp_path.iterdir())))
        write_curve(write_run(results, "fig5", PARALLEL, settings=settings), [4, 3, 2, 1], {0: 0.4, 2: 0.1, 3: 0.2})
        said = told(page_of(results, "fig5"))
        assert all(one in said for one in words)


def test_fig5_data_holds_runs_medians_and_correlation(completions):
    data = page_of(completions, "fig5").data
    runs = data[(data["kind"] == "run") & (data["row"] == PARALLEL)]
    assert list(runs["total"]) == [4, 3, 2, 1] and list(runs["seconds"]) == [0.5, 1.0, 1.5, 2.0]
    failed = data[(data["kind"] == "run") & (data["row"] == "+ aggressive")]
    assert list(failed["status"]) == ["crashed"] and list(failed["reason"]) == ["early"]
    medians = data[(data["kind"] == "median") & (data["row"] == DYNAMIC)].dropna(subset="total")
    assert list(medians["total"]) == [6, 6, 4, 2]  # the diverged run counts as infinite from its third iteration on
    assert list(medians["n"]) == [3] * 4
    rho = data[data["kind"] == "correlation"].set_index("row")
    assert rho.loc[PARALLEL, "spearman"] == pytest.approx(0.5) and rho.loc[PARALLEL, "n"] == 1
    assert rho.loc[DYNAMIC, "spearman"] == pytest.approx(1) and rho.loc[DYNAMIC, "n"] == 2  # runs, each by itself
    said = page_of(completions, "fig5").verdict
    assert "0.7 or more in 1 of 2 different rows; not in + parallel (*0.50*)." in said
    assert rho.loc["+ aggressive", "spearman"] is None and rho.loc["+ aggressive", "n"] == 0


def test_fig5_counts_rows_that_are_one_computation_once(tmp_path):
    for label, losses in ((PARALLEL, [4, 3, 2, 1]), (DYNAMIC, [4, 3, 2, 1]), (NAIVE, [5, 4, 3, 2])):
        end = 0.2 if label == NAIVE else 0.1
        write_curve(write_run(tmp_path, "fig5", label), losses, {0: 0.4, 2: 0.3, 3: end})
    assert "0.7 or more in 2 of 2 different rows" in page_of(tmp_path, "fig5").verdict


def test_fig5_plots_the_numbers_of_its_csv(completions):
    made = page_of(completions, "fig5")
    medians = made.data[(made.data["kind"] == "median") & (made.data["row"] == PARALLEL)]
    loss, chamfer = (medians.dropna(subset=name) for name in ("total", "chamfer_l2"))
    axes = made.figure.axes
    assert list(axes[0].lines[0].get_ydata()) == list(loss["total"])
    assert list(axes[1].lines[0].get_xdata()) == list(loss["seconds"])
    assert list(axes[2].lines[0].get_xdata()) == list(chamfer["iteration"]) == [0, 2, 3]
    assert list(axes[2].lines[0].get_ydata()) == pytest.approx([1000 * x for x in chamfer["chamfer_l2"]])
    assert "× 1000" in axes[2].get_ylabel()
    line = made.table.set_index("Method").loc[PARALLEL]
    assert (line["End"], line["ρ"]) == ("200", "0.500")
    assert all(axis.get_xlabel() and axis.get_ylabel() for axis in axes)
    for words in ("no curve.jsonl", "infinite"):
        assert words in told(made)
    for words in ("2 of 5 runs did not end ok", "diverged (loss rose)", "n = 5 runs (1 shape, 3 seeds)"):
        assert words in made.caption


def test_in_fig5_a_row_of_which_every_run_failed_is_not_the_best(tmp_path):
    write_curve(write_run(tmp_path, "fig5", PARALLEL), [4, 3], {0: 0.4, 1: 0.3})
    for seed in (0, 1):
        lost = {"settings": {"seed": seed}, "status": "not_reached", "reason": "far"}
        write_curve(write_run(tmp_path, "fig5", DYNAMIC, **lost), [4, 3], {0: 0.2, 1: 0.1})
    made = page_of(tmp_path, "fig5")
    assert made.table.set_index("Method")["End"].to_dict() == {PARALLEL: "300", DYNAMIC: "∞"}
    assert f": *300* ({PARALLEL}) to ∞ ({DYNAMIC}); n = 1 run per row." in made.verdict
    runs = chosen(tmp_path, "fig5")
    assert fig5.make(runs.where(runs.frame.row == DYNAMIC)).verdict == ""


def test_curve_with_broken_lines_is_read_as_far_as_it_goes(tmp_path):
    text = '{"iteration": 0, "seconds": 1, "total": "inf"}\n[1]\n{"iteration": 1, "sec'
    (tmp_path / "curve.jsonl").write_text(text)
    curve, remark = curves.read(tmp_path)
    assert list(curve["total"]) == [float("inf")] and remark == "2 lines of curve.jsonl cannot be read"


def test_experiments_of_nothing_but_failures_are_still_made(tmp_path):
    for name in PAGES:
        write_run(tmp_path, name, NAIVE, status="crashed", reason="early", environment={}, settings={"renderer": None})
        made = page_of(tmp_path, name)
        assert set(made.data["row"].dropna()) == {NAIVE} and "crashed" in set(made.data["status"])
        assert "The run did not end ok" in made.caption
        assert made.figure is None or made.figure.draw_without_rendering() is None


def test_command_writes_all_files_and_the_page_shows_them(reported):
    drawn_too = {".csv", ".md", ".tex", ".json", ".png", ".pdf"}
    table_alone = {".csv", ".md", ".tex", ".json"}
    suffixes = {"table1": table_alone, "gradients": drawn_too, "gradients_visibility": drawn_too}
    written = {path.name for path in (reported / "paper").iterdir()}
    assert written == {name + suffix for name, them in suffixes.items() for suffix in them}
    page = Page(reported)
    found = [page.paper(paper["name"]) for paper in page.papers]
    links = {link for whole in found for link in [*whole["files"].values(), whole["picture"]] if link}
    assert links == {f"paper/{name}" for name in written if not name.endswith(".json")}
    assert "+ dynamic" in page.paper("table1")["rows"][0]
    assert [paper["name"] for paper in page.papers] == ["table1", "gradients", "gradients_visibility"]
    assert (reported / "paper" / "gradients.png").read_bytes()[:4] == b"\x89PNG"


def test_page_alone_makes_nothing(judged):
    write_index(judged)
    assert not (judged / "paper").exists()


def test_same_records_give_the_same_files(reported, tmp_path, capsys):
    copy = shutil.copytree(reported, tmp_path / "results")
    main([f"results_dir={copy}"])
    assert capsys.readouterr().out.splitlines()[-1] == str(copy / "index.html")
    first, second = ({path.name: path.read_bytes() for path in (each / "paper").iterdir()} for each in (reported, copy))
    assert first == second


def test_row_keeps_its_look_and_known_rows_differ():
    assert figure_style.look("mine") == figure_style.look("mine") != figure_style.look("yours")  # that nobody listed
    strategies = [figure_style.look(preset) for preset in published("dist_table1")]
    assert len({look.colour for look in strategies}) == len({look.marker for look in strategies}) == 7


def test_drawing_leaves_the_settings_of_matplotlib_alone(judged):
    import matplotlib

    before = dict(matplotlib.rcParams)
    page_of(judged, "gradients")
    assert dict(matplotlib.rcParams) == before
