"""Results folders for the browser: few runs with pictures and meshes, or thousands without them."""

import json
import random
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from bench.report.site.rays import MAP_FILE, RAYS_FILE, RAYS_FOLDER, ray_file
from tests.report.test_report import record

PICTURES = ("summary.png", "curve.png")
FAMILIES = ("sofa", "plane", "car")
RENDERERS = ("dist", "dvr", "idr", "newton", "naive")


def write(results: Path, number: int, **changed) -> Path:
    """A run of a small results folder, with curve, pictures and mesh."""
    name = changed.pop("folder", f"completion-{number:04d}")
    renderer, family = RENDERERS[number % len(RENDERERS)], FAMILIES[number % len(FAMILIES)]
    stored_record = record(name, renderer=renderer, dataset=family, scene=f"{family} test {number}", seed=number % 2)
    error = 0.001 * (1 + number)
    stored_record["metrics"] |= {"chamfer_l2": error, "fscore": 1 / (1 + number)}
    stored_record["config"] |= {
        "renderer": {"_label_": renderer.upper(), "steps": 50},
        "index": number,
        "seed": number % 2,
    }
    stored_record["seconds"] |= {"forward": 1.0 + number, "backward": 0.5}
    stored_record["overrides"] = ["task=completion", f"renderer={renderer}"]
    stored_record["started"] = f"2025-03-{1 + number % 28:02d}T10:00:00+00:00"
    stored_record |= changed
    folder = results / "runs" / name
    folder.mkdir(parents=True)
    (folder / "record.json").write_text(json.dumps(stored_record), encoding="utf-8")
    lines = [
        {"iteration": n, "seconds": 0.1 * n, "value_evaluations": 100 * n, "total": 2.0 / (n + 1)}
        | ({"chamfer_l2": error * 8 / (n + 1)} if n in (0, 1, 3, 7) else {})
        for n in range(8)
    ]
    (folder / "curve.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    for index, picture in enumerate(PICTURES):
        Image.new("RGB", (40, 30), (80 * index, 120, 40 * number % 256)).save(folder / picture)
    write_mesh(folder / "mesh.ply", number)
    return folder


def write_rays(folder: Path, pixels: list[tuple[int, int]], **changed) -> Path:
    """Writes the rays of an image of 8 x 4 pixels into a run folder, as bench.ray does."""
    (folder / RAYS_FOLDER).mkdir()
    drawn = [{"column": x, "row": y, "error": 0.1, "texts": ["", "", f"ray {x}"]} for x, y in pixels]
    content = {"width": 8, "height": 4, "rays": drawn} | changed
    (folder / RAYS_FOLDER / RAYS_FILE).write_text(json.dumps(content))
    for name in (MAP_FILE, *map(ray_file, range(1, len(pixels) + 1))):
        (folder / RAYS_FOLDER / name).write_bytes(b"")
    return folder / RAYS_FOLDER


def write_mesh(path: Path, number: int = 0) -> None:
    """Writes a sphere in the format of runs: doubles, and triangles with indices of 32 bits."""
    ball = trimesh.creation.icosphere(3, 0.3 + 0.05 * number)
    vertices, faces = np.asarray(ball.vertices, "<f8"), np.asarray(ball.faces, "<i4")
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode() + vertices.tobytes() + rows.tobytes())


def write_many(results: Path, count: int) -> None:
    """Writes `count` runs of three tasks without files, with records of the size of desk-scale runs."""
    draw = random.Random(0)
    for number in range(count):
        renderer, family = draw.choice(RENDERERS), draw.choice(FAMILIES)
        task = draw.choice(("completion", "completion", "multiview", "pose"))
        status = draw.choices(("ok", "timeout", "crashed"), (90, 5, 5))[0]
        name = f"{task}-{renderer}-{family}-{number:012x}"
        stored_record = record(name, task=task, renderer=renderer, dataset=family, scene=f"{family} test {number % 16}")
        stored_record["config"] |= {
            "renderer": {"_label_": renderer.upper(), "steps": draw.choice((20, 50))},
            "index": number % 16,
        }
        stored_record["metrics"] = {
            key: draw.uniform(0.001, 1) for key in ("chamfer_l2", "accuracy", "fscore", "mask_iou", "depth_mae")
        }
        stored_record |= {
            "status": status,
            "reason": "" if status == "ok" else "more than 600 s, in the phase optimise",
        }
        stored_record["started"] = f"2025-{1 + number % 12:02d}-{1 + number % 28:02d}T10:00:00+00:00"
        folder = results / "runs" / name
        folder.mkdir(parents=True)
        (folder / "record.json").write_text(json.dumps(stored_record), encoding="utf-8")
