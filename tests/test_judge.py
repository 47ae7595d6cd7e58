"""The command bench.judge: closed forms, pairs of files, cameras and masks of photographs, records, and errors."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

import bench
from bench.evaluate.evaluate import DEFINITIONS, surface_metrics
from bench.judge import Item, Judge, Verdict, main, metric_units, parse_arguments, write_row
from bench.merge import merge
from bench.records.record import Record, read_record
from bench.report.data.records import family
from bench.tasks.reconstruction import dtu, tanks
from bench.tasks.reconstruction.dtu import METRIC_NAMES, dtu_metrics, read_scan
from datasets.files.meshes import read_mesh
from datasets.files.own_photographs import ReadSettings, read_capture
from datasets.mesh import Mesh
from datasets.scene import sample_surface
from tests.made_dtu import CENTRE, ball, on_ball, solid, write_dtu
from tests.made_photographs import CENTRE as PHOTOGRAPHED
from tests.made_photographs import RADIUS, idr

FEW = ("--points", "4000")
pytestmark = pytest.mark.usefixtures("few_samples")


def judged(capsys, *arguments, code: int = 0) -> dict[str, dict[str, float]]:
    """The printed metrics of each mesh; `notes` has the other lines as keys."""
    assert main([*map(str, arguments)]) == code
    names, metric_units, *lines = capsys.readouterr().out.splitlines()
    names, rows = names.split(), {"notes": {}}
    assert len(metric_units) == len(lines[0])
    for line in lines:
        name, *values = line.split()
        if len(values) == len(names) and re.fullmatch(r"[\d.e+-]+|inf|nan", values[0]):
            rows[name] = dict(zip(names, map(float, values), strict=True))
        else:
            rows["notes"][line] = 0.0
    return rows


def refused(capsys, *arguments) -> str:
    assert main([*map(str, arguments)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    return error


def pair(files: Path, name: str) -> tuple:
    return files / f"found/{name}.ply", "--truth", files / f"truth/{name}.ply", *FEW


def plate(height: float) -> Mesh:
    corners = np.array([[0.0, 0, height], [10, 0, height], [10, 10, height], [0, 10, height]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.fixture
def files(tmp_path) -> Path:
    """Two spheres and a plate as truth; larger spheres and a shifted plate as results."""
    for folder, more, height in (("truth", 0.0, 0.0), ("found", 0.2, 1.0)):
        (tmp_path / folder).mkdir()
        ball(2.0 + more).save(tmp_path / folder / "small.ply")
        ball(4.0 + more).save(tmp_path / folder / "large.ply")
        plate(height).save(tmp_path / folder / "plate.ply")
    return tmp_path


@pytest.mark.slow
def test_spheres_and_plates_are_as_far_apart_as_they_were_made(files, capsys):
    # A nearest point is off the nearest surface point by half the spacing of 4,000 points: 0.06 for 4 pi 2^2.
    for name, distance, sampling_error in (("small", 0.2, 0.06), ("plate", 1.0, 0.08)):
        metrics = judged(capsys, *pair(files, name))[name]
        upper = (distance**2 + 2 * sampling_error**2) ** 0.5
        for metric in ("accuracy", "completeness", "chamfer_l1"):
            assert 0.99 * distance < metrics[metric] < upper
        assert 0.98 * distance**2 < metrics["chamfer_gt_to_pred"] < upper**2 and metrics["normal_consistency"] > 0.99
        assert metrics["chamfer_l2"] == pytest.approx(2 * metrics["chamfer_gt_to_pred"], rel=0.1)


@pytest.mark.slow
def test_the_threshold_is_in_units_or_per_cent_of_the_truths_extent(files, capsys):
    texts = ("0.999", "1.1", "1.005", f"{100.5 / 200**0.5}%")
    commands = [(*pair(files, "plate"), f"--threshold={text}") for text in (*texts, "0", "-1", "x", "1%%")]
    none, most, absolute, percentage = (judged(capsys, *arguments)["plate"]["fscore"] for arguments in commands[:4])
    assert none == 0 and most > 0.99 and 0.2 < absolute == percentage < 0.95  # no point is nearer than 1
    assert all("--threshold must be a positive number" in refused(capsys, *arguments) for arguments in commands[4:])


def test_a_cloud_is_a_truth_and_has_no_normals(files, capsys):
    points = on_ball(6000, 2.0)  # more than are drawn, from below to above
    trimesh.PointCloud(points[points[:, 2].argsort()]).export(files / "cloud.ply")
    metrics = judged(capsys, files / "found/small.ply", "--truth", files / "cloud.ply", *FEW)["small"]
    assert "normal_consistency" not in metrics and metrics["chamfer_l1"] == pytest.approx(0.2, abs=0.02)


def test_in_the_unit_sphere_the_size_of_the_files_does_not_count(files, capsys):
    meshes = [read_mesh(files / name / "small.ply") for name in ("truth", "found")]
    for mesh, name in zip(meshes, ("a", "small"), strict=True):
        mesh.moved(np.array([[7.0, 0, 0, 50], [0, 7, 0, 1], [0, 0, 7, -9], [0, 0, 0, 1]])).save(files / f"{name}.ply")
    first = judged(capsys, *pair(files, "small"), "--unit-sphere")
    second = judged(capsys, files / "small.ply", "--truth", files / "a.ply", *FEW, "--unit-sphere")
    assert second["small"] == pytest.approx(first["small"], rel=1e-3)
    assert first["small"]["accuracy"] == pytest.approx(0.97 * 0.2 / 2, abs=0.007)
    ball(4.0, (30.0, 0, 0)).save(files / "twice.ply")  # twice as large, and elsewhere
    ball(2.0, (0, 0, 0)).save(files / "at origin.ply")
    twice = judged(capsys, files / "twice.ply", "--truth", files / "at origin.ply", *FEW, "--unit-sphere")["twice"]
    assert twice["accuracy"] == pytest.approx(0.97 * (30 - 1) / 2, rel=0.1)


def test_the_best_possible_distance_is_that_of_two_independent_samplings_of_the_truth(files, capsys):
    notes = judged(capsys, *pair(files, "small"))["notes"]
    (distance,) = (float(note.rpartition(" ")[2]) for note in notes if note.startswith("two samplings of the truth"))
    truth = read_mesh(files / "truth/small.ply")
    first, second = (sample_surface(truth, 4000, seed) for seed in (7, 8))
    assert distance == pytest.approx(surface_metrics(first, second, threshold=1.0)["chamfer_l1"], rel=0.05)
    assert distance == pytest.approx(0.5 * (4 * np.pi * 2.0**2 / 4000) ** 0.5, rel=0.15)


def test_a_mesh_in_another_frame_than_its_truth_has_a_warning_with_the_change(files, capsys):
    """The changes themselves are in `tests/datasets/test_coincidence.py`."""
    mesh, rows = solid(), ("--method", "mine", "--into", files / "results")
    mesh.save(files / "truth.ply")
    y_up = np.eye(4)[[0, 2, 1, 3]] * np.array([[1], [-1], [1], [1]])
    for motion, words in ((np.diag([10, 10, 10, 1]), "(centimetres against millimetres?)"), (y_up, "about x (z up")):
        mesh.moved(motion).save(files / "mesh.ply")
        command = (files / "mesh.ply", "--truth", files / "truth.ply", *FEW)
        (warning,) = [note for note in judged(capsys, *command)["notes"] if note.startswith("warning")]
        assert words in warning.replace("millimetres against centimetres", "centimetres against millimetres")
        assert "add --unchecked" in refused(capsys, *command, *rows) and not (files / "results").exists()
    judged(capsys, *command, *rows, "--unchecked")
    assert (files / "results/index.html").is_file()


def test_a_poor_reconstruction_is_judged_and_its_row_is_written(files, capsys):
    mesh, draw = solid(), np.random.default_rng(0)
    mesh.save(files / "truth.ply")
    noise = 0.08 * draw.normal(size=mesh.vertices.shape)
    blob, shrunk, noisy = (
        ball(0.6, (0, 0, 0)),
        mesh.moved(np.diag([0.75, 0.75, 0.75, 1])),
        Mesh(mesh.vertices + noise, mesh.faces),
    )
    for name, poor in (("blob", blob), ("shrunk", shrunk), ("noisy", noisy)):
        poor.save(files / f"{name}.ply")
        command = (files / f"{name}.ply", "--truth", files / "truth.ply", *FEW)
        notes = judged(capsys, *command, "--method", name, "--into", files / "results")["notes"]
        assert not any(note.startswith("warning") for note in notes)


def test_a_folder_has_a_row_for_each_truth_and_medians(files, capsys):
    complete = judged(capsys, files / "found", "--truth", files / "truth", *FEW)
    for metric, middle in complete.pop("median").items():
        assert middle == sorted(complete[name][metric] for name in ("large", "plate", "small"))[1]
    (files / "found/large.ply").unlink()
    (files / "found/plate.ply").write_bytes(b"")
    incomplete = judged(capsys, files / "found", "--truth", files / "truth", *FEW, code=1)
    assert list(incomplete) == ["notes", "large", "plate", "small", "median"]
    assert [incomplete[name]["chamfer_l1"] for name in ("large", "plate", "median")] == [np.inf] * 3
    assert incomplete["large"]["fscore"] == 0 < incomplete["small"]["normal_consistency"]
    plate(0.0).save(files / "found/stray.ply")
    error = refused(capsys, files / "found", "--truth", files / "truth")
    assert "stray.ply has no truth: name it as a file of" in error


def test_what_is_no_mesh_is_refused_by_its_cause(files, capsys):
    truth = files / "truth/small.ply"
    trimesh.PointCloud(on_ball(50)).export(files / "points.ply")
    (files / "empty.ply").write_bytes(b"")
    (files / "broken.ply").write_bytes(truth.read_bytes()[:500])
    for name, words in (
        ("points", "must have faces, found none: it holds 50 vertices"),
        ("empty", "must hold a mesh, found 0 bytes"),
        ("broken", "must be a whole .ply file, but it is truncated"),
        ("gone", "found nothing at"),
    ):
        assert words in refused(capsys, files / f"{name}.ply", "--truth", truth)
        assert name == "points" or words in refused(capsys, truth, "--truth", files / f"{name}.ply")
    assert "is a folder and --truth" in refused(capsys, files / "found", "--truth", truth)
    assert "is a folder, and" in refused(capsys, truth, "--truth", files / "truth")
    (files / "one.obj").write_text("v 0 0 0\nv 0 0 0\n")
    assert "must differ, found 2 at one place" in refused(capsys, truth, "--truth", files / "one.obj")
    assert "--points must be at least 1" in refused(capsys, truth, "--truth", truth, "--points", 0)
    assert "--seed must be at least 0, found -1" in refused(capsys, truth, "--truth", truth, "--seed", -1)
    assert "add --method NAME" in refused(capsys, truth, "--truth", truth, "--into", files / "results")
    for option in (["--unit-sphere"], ["--threshold", "2"]):
        assert "are for --truth: --dtu has mm" in refused(capsys, truth, "--dtu", files, *option)
    assert "does not end in the number of a scan" in refused(capsys, truth, "--dtu", files)


def test_dtus_protocol_and_meshes_of_photographs_unit_sphere_and_masks(tmp_path, capsys):
    (tmp_path / "photos").mkdir()
    idr(tmp_path / "photos")
    write_dtu(tmp_path / "dtu", on_ball(4000, RADIUS) - CENTRE + PHOTOGRAPHED, plane=(0, 0, 1, 0), centre=PHOTOGRAPHED)
    in_world = ball(1.03 * RADIUS, PHOTOGRAPHED)
    in_world.save(tmp_path / "there65.ply")
    capture = read_capture(tmp_path / "photos", ReadSettings(800))
    in_world.moved(np.linalg.inv(capture.to_world)).save(tmp_path / "scan65.ply")
    stray = ball(0.1 * RADIUS, PHOTOGRAPHED + np.array([0, 0, 1.6 * RADIUS]))
    faces = np.concatenate([in_world.faces, stray.faces + len(in_world.vertices)])
    Mesh(np.concatenate([in_world.vertices, stray.vertices]), faces).save(tmp_path / "both65.ply")
    expected = dtu_metrics(in_world, read_scan(tmp_path / "dtu", 65), seed=0)
    dtu = ("--dtu", tmp_path / "dtu")
    first = judged(capsys, tmp_path / "there65.ply", *dtu)
    assert first["there65"] == pytest.approx(expected, rel=1e-3) and tuple(first["there65"]) == METRIC_NAMES
    assert any("DVR (RGB): 0.907" in note for note in first["notes"])
    moved = judged(capsys, tmp_path / "scan65.ply", *dtu, "--to-world", tmp_path / "photos")
    assert moved["scan65"] == pytest.approx(expected, rel=1e-3)
    plain = judged(capsys, tmp_path / "both65.ply", *dtu)["both65"]
    culled = judged(capsys, tmp_path / "both65.ply", *dtu, "--cull", tmp_path / "photos")["both65"]
    assert plain["dtu_accuracy"] > 1.1 * culled["dtu_accuracy"] and culled == pytest.approx(expected, rel=0.05)
    read_mesh(tmp_path / "both65.ply").moved(np.linalg.inv(capture.to_world)).save(tmp_path / "moved65.ply")
    more = ("--to-world", tmp_path / "photos", "--cull", tmp_path / "photos")
    assert judged(capsys, tmp_path / "moved65.ply", *dtu, *more)["moved65"] == pytest.approx(culled, rel=1e-3)
    stray.save(tmp_path / "away65.ply")
    error = refused(capsys, tmp_path / "away65.ply", *dtu, "--cull", tmp_path / "photos")
    assert "leave nothing of the mesh" in error
    ball(1.0, PHOTOGRAPHED + 500).save(tmp_path / "far65.ply")
    assert "nothing of the mesh lies within 20 mm of scan 65" in refused(capsys, tmp_path / "far65.ply", *dtu)


def test_a_run_on_photographs_is_judged_by_its_mesh_in_their_world(files, capsys):
    (files / "run").mkdir()
    (files / "run/record.json").write_text("{}")
    ball(9.0).save(files / "run/mesh.ply")
    judge = (files / "run", "--truth", files / "truth/small.ply", *FEW)
    assert judged(capsys, *judge)["run"]["accuracy"] > 5
    ball(2.2).save(files / "run/mesh_world.ply")
    assert judged(capsys, *judge)["run"]["accuracy"] == pytest.approx(0.2, rel=0.1)


def test_the_printed_unit_of_a_metric_is_in_its_definition():
    for name, unit in metric_units(Judge(None, "1%", 1, 0, False, None, None)).items():
        kinds = {"from 0 to 1": "", "in squared scene units": "unit²", "in scene units": "unit"}
        assert unit == next(kinds[words] for words in kinds if words in DEFINITIONS[name]), name


def test_records_join_those_of_runs_and_are_merged(files, capsys):
    (files / "found/large.ply").unlink()
    results, common = files / "results", ("--truth", files / "truth", *FEW, "--method", "My net")
    for _ in range(2):  # the second time they are replaced
        assert main([*map(str, (files / "found", *common, "--into", results))]) == 1
    assert capsys.readouterr().out.splitlines()[-1] == str(results / "index.html")
    assert merge([results], files / "all") == ([], [])
    runs = bench.load(files / "all").set_index("scene")
    assert set(runs.name) == {"My net"} and set(runs.index) == {"small", "large", "plate"}
    assert runs.status.to_dict() == {"small": "ok", "plate": "ok", "large": "empty"}
    assert runs.chamfer_l1["large"] == np.inf and "no mesh is named 'large'" in runs.reason["large"]
    assert "My net" in "".join(file.read_text() for file in (results / "page" / "data" / "list").rglob("*.js"))


def test_rows_of_other_truths_and_settings_are_other_rows(files, capsys):
    results, common = files / "results", ("--method", "Mine", "--into", files / "results")
    for name in ("small", "large"):
        (files / name).mkdir()
        ball(2.0 if name == "small" else 4.0).save(files / name / "mesh.ply")
        judged(capsys, files / name / "mesh.ply", "--truth", files / f"truth/{name}.ply", *FEW, *common)
    for more in (["--threshold", "2%"], ["--unit-sphere"], ["--threshold", "2%"]):
        judged(capsys, files / "small/mesh.ply", "--truth", files / "truth/small.ply", *FEW, *common, *more)
    tasks = [read_record(folder)["config"]["task"] for folder in (results / "runs").iterdir()]
    settings = sorted((task["truth"], task["threshold"], task["unit_sphere"]) for task in tasks)
    small = [("small.ply", "1%", False), ("small.ply", "1%", True), ("small.ply", "2%", False)]
    assert settings == [("large.ply", "1%", False), *small]


def test_rows_of_scenes_and_scans_have_their_names(files):
    name, common = "mesh", ["mesh.ply", "--method", "Mine", "--into", str(files)]
    for truth, more in (("Barn", []), ("Truck", []), ("Barn", ["--surface"]), ("Barn", ["--no-icp"])):
        options = parse_arguments([*common, "--tnt", "TNT", *more])
        settings = tanks.TanksSettings(None, options.icp, options.surface)
        judge = Judge(None, "1%", 1, 0, False, None, None, options.tnt, settings)
        write_row(Verdict(name, dict(tanks.WORST)), Item(name, options.mesh, truth), 0, judge, options)
    options = parse_arguments([*common, "--dtu", "DTU"])
    judge = Judge(options.dtu, "1%", 1, 0, False, None, None)
    write_row(Verdict(name, dict(dtu.WORST)), Item(name, options.mesh, 65), 0, judge, options)
    records = [read_record(folder) for folder in (files / "runs").iterdir()]
    assert sorted(record["scene"] for record in records) == ["Barn"] * 3 + ["Truck", "scan65"]
    assert {family(record) for record in records} == {"TNT/Barn", "TNT/Truck", "DTU/scan65"}


def test_a_failed_mesh_in_a_folder_has_no_row_if_the_others_are_in_another_frame(files, capsys):
    (files / "found/large.ply").unlink()  # judged first
    (files / "found/plate.ply").unlink()
    solid().save(files / "truth/small.ply")
    solid().moved(np.diag([10, 10, 10, 1])).save(files / "found/small.ply")
    command = (files / "found", "--truth", files / "truth", *FEW, "--method", "Mine", "--into", files / "results")
    assert main([*map(str, command)]) == 2
    assert "error: no row is written" in capsys.readouterr().err and not (files / "results").exists()
    judged(capsys, *command, "--unchecked", code=1)
    assert len([*(files / "results/runs").iterdir()]) == 3


def test_a_record_may_name_the_problem_of_a_run(files, capsys):
    config = {"dataset": {"path": "photos"}, "index": 0, "task": {"longest": 96}, "renderer": {"_label_": "Newton"}}
    config |= {"silhouette": {"_label_": "hinge"}}
    run = Record("run", "reconstruction", "newton", "photos", 3, config, scene="scan65")
    (files / "run").mkdir()
    run.write(files / "run")
    more = ("--like", files / "run", "--method", "NeuS", "--into", files / "results")
    judged(capsys, *pair(files, "small"), *more)
    (folder,) = (files / "results/runs").iterdir()
    row = Record.of(read_record(folder))
    assert (row.name, row.task, row.dataset, row.seed, row.scene) == ("NeuS", "reconstruction", "photos", 3, "scan65")
    assert row.config["task"] == {"longest": 96} and "units of the truth's file" in row.definitions["accuracy"]
    assert (folder / "mesh.ply").is_file()
    assert "--like names the problem of one run" in refused(capsys, files / "found", "--truth", files / "truth", *more)
    Record("run", "completion", "newton", "mesh", 3, config, scene="spot").write(files / "run")
    assert "in scene units: add --unit-sphere" in refused(capsys, *pair(files, "small"), *more)


@pytest.mark.slow
def test_pictures_of_a_folder_have_the_names_of_the_meshes(files, capsys):
    (files / "found/large.ply").unlink()
    (files / "found/plate.ply").unlink()
    common = (files / "found", "--truth", files / "truth", *FEW, "--picture")
    notes = judged(capsys, *common, files / "pictures", code=1)["notes"]
    assert [file.name for file in sorted((files / "pictures").iterdir())] == ["small.csv", "small.png"]
    with (files / "pictures/small.csv").open() as file:
        assert file.readline().strip() == "distance_units,precision,recall,fscore"
    assert sum("how: " in note for note in notes) == 3
    assert "--picture must name a folder for" in refused(capsys, *common, files / "one.png")
