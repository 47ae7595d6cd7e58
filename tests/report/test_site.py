"""What the page is made of: names by what differs, safe scripts, meshes, words of a run."""

import base64
import json
import shlex
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from bench.merge import merge
from bench.records.names import differences
from bench.records.read import not_run_record, read_records
from bench.records.record import NOT_RUN, RunStatus, file_lock
from bench.records.results import RESULTS, Plan, PlannedRun
from bench.report.__main__ import main
from bench.report.data.records import definition
from bench.report.site.columns import columns, names
from bench.report.site.detail import curve, detail
from bench.report.site.files import Folder
from bench.report.site.meshes import mesh_data, read_ply, simplify
from bench.report.site.rays import rays
from bench.report.site.words import STATUSES, TASKS, command, request_sentence
from bench.report.suite.attempts import write_attempts
from bench.report.write import html
from bench.report.write.html import safe_json, to_script, write_index
from tests.browser import made
from tests.looped import each
from tests.report.page_data import Page
from tests.report.test_report import record, write_run
from tests.report.test_suite import attempt

ROOT = Path(__file__).parents[2]
BODY = 177  # where the numbers of the mesh begin


def renderer(**settings) -> dict:
    return {"config": {"renderer": settings}}


def test_a_setting_reads_the_same_in_a_list_and_in_the_table_of_its_sweep():
    swept = [record("x", **renderer(_label_="DIST", epsilon=epsilon)) for epsilon in (1e-4, 5e-5)]
    assert [name.removeprefix("DIST, ") for name in names(swept)] == differences(swept)


def test_runs_are_named_by_what_differs():
    swept = [record("x", **renderer(_label_="DIST", steps=steps, alpha=1.5)) for steps in (20, 50)]
    assert names(swept) == ["DIST, steps 20", "DIST, steps 50"]
    same = [record("x", **renderer(_label_="DIST", steps=20), seed=seed) for seed in (0, 1)]
    assert names(same) == ["DIST", "DIST"]


def test_a_setting_that_follows_from_another_is_not_named():
    sizes = (("small", 32), ("large", 64))
    configs = [{"field": {"name": name}, "view": {"resolution": size}} for name, size in sizes]
    assert names([record("x", config=config) for config in configs]) == ["dist, field small", "dist, field large"]


def test_scale_has_a_column_and_neither_it_nor_what_follows_from_it_is_in_names():
    sizes = (("smoke", 32), ("desk", 64))
    made = [record("x", folder="x", config={"scale": {"name": n}, "view": {"resolution": r}, "task": {"points": p}})
            for n, r in sizes for p in (20, 100)]  # fmt: skip
    assert names(made) == ["dist, points 20", "dist, points 100"] * 2
    found = columns(made, [Folder(Path("none"), f"run{number}") for number in range(4)])["texts"]["scale"]
    assert [found["values"][code] for code in found["codes"]] == ["smoke", "smoke", "desk", "desk"]


def test_own_renderers_are_named_by_their_class():
    own = [record("x", renderer="custom", **renderer(_target_=f"mypkg.{name}")) for name in ("Mine", "Other")]
    assert names(own) == ["Mine", "Other"]
    labelled = record("x", renderer="custom", config={"label": "Ours", "renderer": {"_target_": "mypkg.Mine"}})
    assert names([labelled]) == ["Ours"]


def test_at_most_three_settings_are_named_and_equal_ends_in_full():
    configs = [{"task": {"a": n & 1, "b": n & 2, "c": n & 4, "d": n & 8}} for n in range(16)]
    assert max(name.count(",") for name in names([record("x", config=config) for config in configs])) == 3
    alike = [{"task": {"weight": n & 1}, "renderer": {"weight": n & 2}} for n in range(4)]
    assert names([record("x", config=config) for config in alike])[3] == "dist, weight 2, task.weight 1"


def test_an_odd_configuration_is_shown_all_the_same_and_cut_off_where_it_has_no_end(tmp_path):
    nested: dict = {}
    for _ in range(300):
        nested = {"a": nested}
    odd = [{"renderer": "odd", "silhouette": 3}, {"label": {"a": 1}}, {"dataset": {"path": 5}}, nested]
    for number, config in enumerate(odd):
        write_run(tmp_path, record("odd", config=config), f"odd{number}")
    write_index(tmp_path)
    page = Page(tmp_path)
    assert sorted(page.folders) == ["odd0", "odd1", "odd2", "odd3"]
    ((key, value),) = page.run("odd3")["settings"]
    assert value == "…" and key.count(".") == 20


def test_no_text_can_end_a_script_or_a_line():
    text = "</script><!-- & \u2028\u2029 \ud800 ü"
    made_of = to_script("run", text, {"a": [text, float("inf"), float("nan")]})
    assert made_of.isascii() and not set("<>&") & set(made_of) and made_of.count("\n") == 1
    assert json.loads(safe_json(text)) == text
    assert json.loads(safe_json({"a": float("-inf")})) == {"a": "-inf"}


def test_each_status_has_words_and_all_but_ok_a_remedy():
    assert set(STATUSES) == {*RunStatus, NOT_RUN}
    assert [status for status, words in STATUSES.items() if not words.remedy] == [RunStatus.OK]


def test_each_task_has_words():
    assert set(TASKS) == {path.stem for path in (ROOT / "conf" / "task").glob("[!_]*.yaml")}


def test_what_was_asked_is_a_sentence():
    config = {"task": {"points": "100"}, "view": {"resolution": 32}, "scale": {"name": "smoke"}}
    sentence = request_sentence(record("x", config=config, scene="sofa test 0"))
    assert sentence.startswith("Complete a shape from sparse depth ")
    assert sentence.endswith(": sofa test 0, 100 depth points, 32 × 32 pixels, seed 0, scale=smoke.")


def test_the_command_is_what_was_typed_and_safe_to_paste():
    typed = ["task=completion", "renderer.steps=40", "results_dir=elsewhere", "label=$(rm -rf ~)"]
    line = command(record("x", overrides=typed), Path("my results"))
    assert shlex.split(line) == ["python", "-m", "bench", *typed[:2], typed[3], "results_dir=my results"]


def test_a_planned_cell_has_the_command_that_its_sweep_planned():
    cell = PlannedRun("a", ["+experiment=fig5", "index=1"], "completion", "dist", "car", 0, {})
    planned = not_run_record(cell, Plan("fig5-1", Path(RESULTS), [cell]))
    assert command(planned, Path(RESULTS)) == "python -m bench +experiment=fig5 index=1"


@each(
    "key, name",
    [
        ("lost, false", "false"),
        ("saved_...", "saved_steps"),
        ("frontal.code_cosine", "grazing.code_cosine"),
        ("depth_error", "depth_error_p99"),
    ],
)
def test_a_metric_has_its_definition(key, name):
    assert definition({"hull": "Another.", key: "Known."}, name) == "Known."
    assert definition({key: "Known."}, "unlike") == definition({key: "Known."}, "savedsteps") == ""


def test_costs_are_by_phase_and_add_up(tmp_path):
    write_run(tmp_path, record("one"), "one")
    costs = detail(record("one", notes=[]), Folder(tmp_path, "one"), tmp_path)["costs"]
    assert sum(spent for _, spent, _ in costs["phases"]) == costs["total"] == 31.5
    assert [label for label, _, loop in costs["phases"] if loop] == ["optimisation: forward", "optimisation: backward"]


def test_a_long_curve_is_thinned_but_keeps_its_ends_and_checkpoints(tmp_path):
    folder = write_run(tmp_path, record("one"), "one")
    lines = [{"iteration": n, "total": 1.0} | ({"chamfer_l2": 0.1} if n == 1001 else {}) for n in range(5000)]
    (folder / "curve.jsonl").write_text("\n".join(map(json.dumps, lines)))
    kept = curve(Folder(tmp_path, "one"))["iteration"]
    assert len(kept) < 250 and {0, 1001, 4999} <= set(kept)


def unpacked(part: dict) -> np.ndarray:
    return np.frombuffer(base64.b64decode(part["bdata"]), f"<{part['dtype']}")


def test_a_mesh_is_given_as_plotly_reads_it_with_our_second_axis_up(tmp_path):
    made.write_mesh(tmp_path / "mesh.ply")
    whole, data = read_ply(tmp_path / "mesh.ply"), mesh_data(tmp_path / "mesh.ply")
    x, y, z = (unpacked(data[axis]) for axis in "xyz")
    assert np.allclose(np.stack([x, z, -y], axis=1), whole.vertices, atol=1e-6)
    assert (np.stack([unpacked(data[corner]) for corner in "ijk"], axis=1) == whole.faces).all()
    assert data["whole"] == data["shown"] == [642, 1280] and "vertexcolor" not in data


def test_a_large_mesh_is_merged_to_few_vertices_near_the_surface(tmp_path):
    torus = trimesh.creation.torus(1, 0.3, 150, 150)
    torus.visual.vertex_colors = np.tile(np.uint8([40, 80, 120, 255]), (len(torus.vertices), 1))
    small = simplify(torus, 5000)
    assert 1000 < len(small.vertices) <= 5000 and small.faces.max() < len(small.vertices)
    around = np.hypot(np.hypot(small.vertices[:, 0], small.vertices[:, 1]) - 1, small.vertices[:, 2])
    assert np.abs(around - 0.3).max() < 0.02
    (tmp_path / "mesh.ply").write_bytes(small.export(file_type="ply"))
    assert {*mesh_data(tmp_path / "mesh.ply")["vertexcolor"]} == {"#285078"}


def test_a_mesh_that_names_a_texture_reads_no_other_file(tmp_path, caplog):
    made.write_mesh(tmp_path / "mesh.ply")
    content = (tmp_path / "mesh.ply").read_bytes()
    named = content.replace(b"element vertex", b"comment TextureFile ../secret.png\nelement vertex")
    (tmp_path / "mesh.ply").write_bytes(named)
    assert len(read_ply(tmp_path / "mesh.ply").faces) == 1280 and not caplog.records


@each(
    "change, why",
    [
        (lambda content: content[:-40], "unexpected length"),
        (lambda content: content.replace(b"vertex 642", b"vertex 4000000000"), "unexpected length"),
        (lambda content: content.replace(b"binary_little", b"binary_big"), "not of its vertices"),
        (lambda content: content.replace(b"double x", b"double u"), "no field of name x"),
        (lambda content: content.replace(b"double x", b"double y"), "could not be read"),
        (lambda content: content.replace(b"double x", b"object x"), "could not be read"),
        (lambda content: content.replace(b"uchar int", b"double int"), "could not be read"),
        (lambda content: b"", "Not a ply file"),
        (lambda content: content[:-4] + b"\xff\xff\xff\x7f", "not of its vertices"),
        (lambda content: content[:BODY] + b"\xff" * 8 + content[BODY + 8 :], "not finite"),
    ],
)
def test_a_mesh_that_cannot_be_read_is_said_to_be(tmp_path, change, why):
    made.write_mesh(tmp_path / "mesh.ply")
    (tmp_path / "mesh.ply").write_bytes(change((tmp_path / "mesh.ply").read_bytes()))
    with pytest.raises(ValueError, match=why):
        mesh_data(tmp_path / "mesh.ply")


def test_meshes_are_made_of_the_newest_runs_and_once(tmp_path, monkeypatch):
    for number in range(3):
        made.write(tmp_path, number)
    write_index(tmp_path, meshes=2)
    page = Page(tmp_path)
    shown = [(page.data / "mesh" / f"{key}.js").is_file() for key in page.runs["key"]]
    assert page.folders[-1] == "completion-0000" and shown == [True, True, False]
    monkeypatch.setattr("bench.report.site.meshes.read_ply", lambda path: pytest.fail("was made already"))
    write_index(tmp_path, meshes=2)
    monkeypatch.undo()
    write_index(tmp_path, meshes=None)
    assert all("x" in Page(tmp_path).read("mesh", key) for key in page.runs["key"])
    (tmp_path / "runs" / page.folders[0] / "mesh.ply").write_bytes(b"")
    write_index(tmp_path)
    assert "Not a ply file" in Page(tmp_path).read("mesh", page.runs["key"][0])["none"]


def test_runs_share_scripts_from_which_each_has_its_own_details(tmp_path, monkeypatch):
    monkeypatch.setattr(html, "KEY_PREFIX_LETTERS", 1)
    for number in range(20):
        made.write(tmp_path, number, folder=f'run "{number}"' if number % 2 else f"run-{number}")
    write_index(tmp_path)
    page = Page(tmp_path, beginning=1)
    assert len(list((page.data / "run").iterdir())) <= 16
    for found in read_records(tmp_path)[0]:
        whole = detail(found, Folder(tmp_path, found["folder"]), tmp_path)
        assert page.run(found["folder"]) == json.loads(safe_json(whole))


def test_what_is_gone_leaves_the_page(tmp_path):
    for number in range(2):
        made.write(tmp_path, number)
    write_index(tmp_path)
    for path in (folder := tmp_path / "runs" / "completion-0001").iterdir():
        path.unlink()
    folder.rmdir()
    write_index(tmp_path)
    for kind in ("run", "mesh"):
        assert len(list((tmp_path / "page" / "data" / kind).iterdir())) == 1


def test_what_another_put_in_the_place_of_a_script_is_replaced(tmp_path):
    results, outside = tmp_path / "results", tmp_path / "outside"
    for number in range(2):
        made.write(results, number)
    write_index(results)
    names = {kind: [path.name for path in (results / "page" / "data" / kind).iterdir()] for kind in ("run", "mesh")}
    for kind, (linked, edited) in names.items():
        folder = results / "page" / "data" / kind
        (folder / linked).rename(outside.with_name(kind))
        (folder / linked).symlink_to(outside.with_name(kind))
        (folder / edited).write_text("evil();")
    (results / "page" / "data" / "run" / f"{'0' * 16}.js").write_text("evil();")
    (results / "page" / "app.js").write_text("evil();")
    write_index(results)
    assert not any("evil();" in path.read_text(encoding="utf-8") for path in (results / "page").rglob("*.js"))
    for kind in names:
        outside.with_name(kind).write_text("evil();")
        for name in names[kind]:
            script = results / "page" / "data" / kind / name
            assert not script.is_symlink() and "evil" not in script.read_text()


def test_pages_that_are_written_at_the_same_time_have_all_runs(tmp_path):
    def end(number: int) -> None:
        made.write(tmp_path, number)
        write_index(tmp_path)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(end, range(4)))
    assert sorted(Page(tmp_path).folders) == [f"completion-{n:04}" for n in range(4)]


def test_who_waits_for_another_page_is_told(tmp_path, monkeypatch):
    write_run(tmp_path, record("one"), "one")
    other, said = file_lock(tmp_path, html.PAGE_FOLDER), []

    def tell(text: str, **_: object) -> None:
        said.append(text)
        other.release()

    other.acquire()
    monkeypatch.setattr(html, "SILENT_WAIT_SECONDS", 0.01)
    monkeypatch.setattr(html, "print", tell, raising=False)
    write_index(tmp_path)
    assert said == [f"waiting for another process that writes the page of {tmp_path}"]


def test_rows_that_were_merged_have_the_suites_page_without_runs(tmp_path):
    solved = attempt("Dist", "car test 0", {0: 0.8, 500: 0.0115, 600: 0.001}, preset="dist")
    mine = replace(solved, row="Mine", preset="custom", status="nan", reason="lost", overrides=[
        *solved.overrides, "renderer=custom", "+renderer.steps=7", "label=My own"])  # fmt: skip
    request_sentence = ["+experiment=core_complete", "+method=tuned/dist_mask", "silhouette=own", "label='Dist, tuned'"]
    tuned = replace(solved, row="Dist, tuned", overrides=request_sentence)
    for name, one in (("a", solved), ("b", mine), ("a", tuned)):
        write_attempts([one], tmp_path / name)
    merge([tmp_path / "a", tmp_path / "b"], tmp_path / "both")
    assert main([f"results_dir={tmp_path / 'both'}"]) == 0
    page = Page(tmp_path / "both")
    shown = page.paper("suite")
    assert [row[0] for row in shown["rows"]] == ["Dist", "Mine"] and shown["chart"]["panels"]
    assert "at 1 unit: 1 problem of 1 scene" in shown["caption"] and "The run ended" not in shown["caption"]
    found = page.read("list", "renderers")
    assert found["problems"] == [["complete", "car test 0, 20 points", 1.0]]
    dist, own, by_itself = found["rows"]
    assert by_itself["command"] == "python -m bench.suite setting=tuned renderer=dist"
    assert (dist["progress"], dist["failed"], dist["runs"]) == ([1.0], [], [None])
    assert (own["progress"], own["failed"]) == ([0.0], [[0, "nan", "lost"]])
    assert own["command"] == "python -m bench.suite renderer=custom +renderer.steps=7 'label=My own'"


def test_an_odd_run_of_the_suite_costs_no_page(tmp_path):
    odd = record("odd", config={"experiment": "core_complete", "dataset": 3}, environment={"cpu": [1]}, seed=0)
    write_run(tmp_path, odd | {"metrics_start": {"chamfer_l1": 1}, "method": ["x"]}, "odd")
    write_index(tmp_path)
    assert Page(tmp_path).folders == ["odd"] or Page(tmp_path).about["problems"]


def test_the_shell_names_every_script_and_each_is_shipped(tmp_path):
    write_run(tmp_path, record("one"), "one")
    write_index(tmp_path)
    shipped = {path.relative_to(html.ASSETS).as_posix() for path in html.ASSETS.rglob("*") if path.is_file()}
    links = [link.removeprefix("page/") for link in Page(tmp_path).shell.links if link.startswith("page/")]
    lists = {f"data/list/{name}.js" for name in ("about", "papers", "runs")}
    assert {*links} == shipped - {"index.html"} | lists and links[-1] == "app.js"
    assert all(len((html.ASSETS / name).read_text(encoding="utf-8").splitlines()) <= 300 for name in shipped)


def test_a_run_lists_its_rays_and_an_ablation_without_them_the_command_that_draws_them(tmp_path):
    for name in ("plain", "drawn", "other"):
        write_run(tmp_path, record(name), name)
    made.write_rays(tmp_path / "runs" / "drawn", [(3, 1), (7, 3)])
    plain, drawn = (rays(record(name, task="ablation"), Folder(tmp_path, name)) for name in ("plain", "drawn"))
    assert rays(record("other"), Folder(tmp_path, "other")) is None and plain["rays"] == []
    assert shlex.split(plain["command"]) == ["python", "-m", "bench.ray", f"{tmp_path}/runs/plain", "pixels=worst"]
    assert drawn["map"] == "runs/drawn/rays/pixels.png"
    first = {"pixel": "3,1", "picture": "runs/drawn/rays/01.png", "text": "ray 3", "left": 43.75, "top": 37.5}
    assert drawn["rays"][0] == first and drawn["rays"][1]["picture"].endswith("02.png")


def test_odd_rays_of_a_run_are_left_out(tmp_path):
    for number, odd in enumerate(
        ({"rays": 3}, {"width": "x"}, {"width": 1e400}, {"rays": [{"column": 1}]}, {"height": 0})
    ):
        folder = write_run(tmp_path, record("odd", task="ablation"), f"odd{number}")
        made.write_rays(folder, [(3, 1)], **odd)
        assert rays(record("odd", task="ablation"), Folder(tmp_path, f"odd{number}"))["rays"] == []
    pictures = made.write_rays(write_run(tmp_path, record("out", task="ablation"), "out"), [(3, 1), (4, 1)])
    (tmp_path.parent / "outside.png").write_bytes(b"")
    (pictures / "01.png").unlink()
    (pictures / "01.png").symlink_to(tmp_path.parent / "outside.png")
    shown = rays(record("out", task="ablation"), Folder(tmp_path, "out"))["rays"]
    assert [ray["pixel"] for ray in shown] == ["4,1"]
