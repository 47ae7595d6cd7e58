"""The commands, the code and the links of the README files, and the files that the commands need."""

import re
import shlex
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
import trimesh
import yaml
from PIL import Image

from datasets.files.shapenet import SYNSETS, ShapeNet
from datasets.views import ViewSampler
from tests.datasets.test_shapenet import IDS, write_renders, write_shape, write_shapenet, write_split
from tests.made_networks import arrays, deepsdf_folder, npz
from tests.made_photographs import CENTRE, RADIUS, dvr, idr
from tests.made_scans import write_scans

ROOT = Path(__file__).resolve().parents[1]
FILES = (
    "README.md",
    "CONTRIBUTING.md",
    *(f"{package}/README.md" for package in ("bench", "conf", "datasets", "renderers")),
)
CODE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
COMMENT = re.compile(r"\s{2,}# .*$")
SPAN = re.compile(r"`((?:python -m |-m \+experiment=)[^`]+)`")  # tables leave `python -m bench` out
LINK = re.compile(r"\]\(([^)#\s]*)(#[^)\s]*)?\)")
DENSE_DEPTHS = "task.depths.points=dense"
NETWORK = re.compile(r"field_path=|prior\.path=")
SCANS = re.compile(r"dataset=scans|\+experiment=scans")


@dataclass(frozen=True)
class Command:
    """A command of a README file, as its words."""

    file: str
    words: tuple[str, ...]

    @property
    def module(self) -> str:
        return self.words[2]

    @property
    def arguments(self) -> tuple[str, ...]:
        return self.words[3:]

    def __str__(self) -> str:
        return " ".join(self.words)


def text_of(file: str) -> str:
    return (ROOT / file).read_text(encoding="utf-8")


def commands() -> list[Command]:
    """All `python -m ...` of the README files: indented lines without their comments, and spans within text."""
    by_text = {}
    for file in FILES:
        bare = CODE.sub("", text_of(file))
        lines = [COMMENT.sub("", line).strip() for line in bare.splitlines() if line.startswith("    ")]
        spans = [" ".join(span.split()) for span in SPAN.findall(bare.replace("\n", " "))]
        full_spans = [f"python -m bench {span}" if span.startswith("-m ") else span for span in spans]
        for text in (text.strip() for line in (*lines, *full_spans) for text in line.split("&&")):
            if text.startswith("python -m "):
                by_text.setdefault(text, Command(file, tuple(shlex.split(text))))
    return list(by_text.values())


def stress_tables() -> list[str]:
    """The tables of stresses for conf/README.md, from the rows and comments of conf/stresses.yaml: one per group."""
    blocks = (ROOT / "conf" / "stresses.yaml").read_text(encoding="utf-8").strip().split("\n\n")[1:]
    stresses, made = yaml.safe_load("\n".join(blocks)), list[str]()
    for block in blocks:
        heading, *lines = block.splitlines()
        rows, comments = list[str](), list[str]()
        for line in lines:
            if line.startswith("# "):
                comments.append(line.removeprefix("# "))
                continue
            name = line.partition(":")[0]
            sweep, meaning = stresses[name]["sweep"], " ".join(comments).rstrip(".")
            mild, severe = (f"{sweep[end]:g}".replace("e-0", "e-") for end in ("mild", "severe"))
            rows.append(f"| `{name}` | {meaning} | {mild} to {severe} {sweep['unit']} |")
            comments = []
        head = f"{heading.removeprefix('# ')}\n\n| `stress=` | meaning | mildest to severest |\n|---|---|---|\n"
        made.append(head + "\n".join(rows))
    return made


def code_of(file: str, language: str) -> list[str]:
    """The code blocks of one language in a README file."""
    return [code for block_language, code in CODE.findall(text_of(file)) if block_language == language]


def links() -> list[tuple[str, str, str]]:
    """The links to other files of the project: the file with the link, the linked file, the heading."""
    all_links = [(file, path, anchor) for file in FILES for path, anchor in LINK.findall(CODE.sub("", text_of(file)))]
    return [link for link in all_links if ":" not in link[1]]


def anchors(text: str) -> set[str]:
    """The addresses of headings, as GitHub makes them, and those that a text sets explicitly."""
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    plain = [re.sub(r"[^\w\- ]", "", re.sub(r"<[^>]*>", "", heading)).strip().lower() for heading in headings]
    return {heading.replace(" ", "-") for heading in plain} | set(re.findall(r'<a id="([^"]+)">', text))


def make_files(folder: Path) -> dict[str, str]:
    """Writes the files that placeholders in commands stand for; gives the path of each placeholder."""
    mine = (f"mine/conf/{group}" for group in ("renderer", "task", "experiment", "dataset"))
    for name in ("captures", "scans", "chairs", "network", *mine):
        (folder / name).mkdir(parents=True)
    idr(folder / "captures")
    write_scans(folder / "scans")
    trimesh.creation.box((1, 0.6, 0.8)).export(folder / "one.obj")
    for number in range(4):
        box = trimesh.creation.box((1, 0.6 + 0.1 * number, 0.8))
        box.visual.vertex_colors = (90, 60, 30, 255)
        box.export(folder / "chairs" / f"{number}.obj")
    picture = Image.new("L", (48, 48))
    picture.paste(255, (12, 16, 40, 32))
    picture.save(folder / "mask.png")
    picture.convert("RGB").save(folder / "picture.png")
    np.save(folder / "depth.npy", np.pad(np.full((24, 32), 2.0), 12))
    named = {"DEPTH": folder / "depth.npy"} | dict.fromkeys(("YOURS.obj", "cow.obj", "spot.obj"), folder / "one.obj")
    named |= {"FOLDER": folder / "captures", "chairs/": folder / "chairs", "my_conf": folder / "mine" / "conf"}
    named |= {"FILE": folder / "picture.png", "MASK": folder / "mask.png"}
    deepsdf_folder(folder / "network", 0.1 * torch.arange(4.0)[:, None])
    (folder / "depths").mkdir()
    if find_spec("cv2"):
        dvr(folder / "depths")
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS).apply_translation(CENTRE)
    trimesh.PointCloud(ball.vertices).export(folder / "tola.ply")
    named |= {"NETWORK": folder / "network", "DEPTHS": folder / "depths", "tola.ply,colmap.ply": folder / "tola.ply"}
    named |= dict.fromkeys(("fox.npz", "mine.npz"), npz(folder, arrays()).path)
    shapenet = write_shapenet(folder / "ShapeNetCore.v2")
    for name in IDS:
        write_shape(shapenet, SYNSETS["car"], name)
    boxes = ShapeNet(str(shapenet), "sofa", None, "onet")
    sampler = ViewSampler(2.5, 50.0, (0, 360), (15, 35), resolution=32)  # pixels of single_view at smoke
    named["NMR"] = write_renders(folder / "NMR", boxes, sampler, views=24)
    named |= dict.fromkeys(("ShapeNetCore.v1", "ShapeNetCore.v2"), shapenet)
    named["SPLIT"] = write_split(folder / "sofas_test.json", IDS[:2])
    blocks = code_of("CONTRIBUTING.md", "python")
    for module, block in (("my_package", 0), ("mypkg", 0), ("mytask", 1), ("mydata", 3)):
        (folder / "mine" / f"{module}.py").write_text(blocks[block])
    yaml = dict(zip(("task", "experiment", "dataset"), code_of("CONTRIBUTING.md", "yaml"), strict=True))
    for group, text in yaml.items():
        name = "rings" if group == "dataset" else "coverage"
        (folder / "mine" / "conf" / group / f"{name}.yaml").write_text(text)
    mine = "_target_: my_package.Mine\n_label_: Mine\nsteps: 40\n"
    (folder / "mine" / "conf" / "renderer" / "mine.yaml").write_text(mine)
    return {word: str(path) for word, path in named.items()} | {"SCANS": str(folder / "scans")}


def filled(command: Command, paths: dict[str, str]) -> list[str]:
    """A command's arguments, with the paths of files for its placeholders and without `...`."""
    named = {"NAME": "sofa", **paths}
    if SCANS.search(str(command)):
        named["FOLDER"] = paths["SCANS"]
    elif DENSE_DEPTHS in command.words:
        named["FOLDER"] = paths["DEPTHS"]
    elif NETWORK.search(str(command)):
        named |= {"FOLDER": paths["NETWORK"], "FILE": paths["fox.npz"]}
    elif "dataset=mesh" in command.words:
        named |= {"FOLDER": paths["chairs/"], "FILE": paths["YOURS.obj"]}
    folders = ["--config-dir", "my_conf", "packages=[my_package]"] if command.arguments == ("renderer=mine",) else []
    words = [argument for argument in (*folders, *command.arguments) if argument not in ("...", "...,")]
    return [key + equals + named.get(value, value) for key, equals, value in (word.rpartition("=") for word in words)]
