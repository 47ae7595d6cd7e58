"""Writes the page as one file to send: its scripts, data and small pictures inside, and nothing beside it."""

import base64
import hashlib
import io
from pathlib import Path
from typing import Any

from PIL import Image

from bench.records.files import write_text
from bench.records.read import read_records
from bench.report.site.columns import columns
from bench.report.site.detail import detail
from bench.report.site.files import Folder
from bench.report.site.papers import papers
from bench.report.site.script import to_script
from bench.report.write.html import ASSETS, POLICY, SCRIPTS, START, STYLES, filled, library
from bench.report.write.paper import FOLDER

NAME = "report.html"
MOST_RUNS = 400  # of the newest, with details and a picture
RUN_WIDTH, FIGURE_WIDTH = 640, 1000  # pixels of the small pictures
LARGEST = 60_000_000  # pixels of a picture that is made small
QUALITY = 70


def write_one_file(results_dir: Path) -> Path:
    """Writes `results_dir/report.html` and gives its path.

    Raises:
        ValueError: if `results_dir` is not a folder.
    """
    records, problems = read_records(results_dir)
    parts = [to_script("list", "runs", columns(records, results_dir))]
    for record in records[:MOST_RUNS]:
        folder = Folder(results_dir, record["folder"])
        parts.append(to_script("run", folder.key, _run(detail(record, folder, results_dir), folder)))
    entries, wholes = papers(results_dir)
    for entry in entries:
        whole = _paper(wholes[entry["key"]], results_dir / FOLDER / f"{entry['name']}.png")
        parts.append(to_script("paper", entry["key"], whole))
    shown = min(len(records), MOST_RUNS)
    left = (
        f"This file was made to be sent. It has details of {shown} of {len(records)} runs, with one small picture "
        f"each; "
        "meshes, other pictures and files are in the results folder alone."
    )
    parts += [
        to_script("list", "papers", entries),
        to_script("list", "about", {"problems": problems, "oneFile": True, "left": left}),
    ]
    path = results_dir / NAME
    write_text(path, _page(parts))
    return path


def _page(parts: list[str]) -> str:
    """The page with all scripts inside; it runs those alone whose hashes it names."""
    code = [(ASSETS / name).read_text(encoding="utf-8") for name in SCRIPTS]
    plotly = library().read_text(encoding="utf-8").replace("</script", "<\\/script")
    scripts = [plotly, *code, *parts, (ASSETS / START).read_text(encoding="utf-8")]
    styles = [(ASSETS / name).read_text(encoding="utf-8") for name in STYLES]
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in scripts
    )
    policy = POLICY.format(scripts=hashes, styles="'unsafe-inline'", pictures="data:")
    style = "\n".join(f"<style>{text}</style>" for text in styles)
    return filled(policy, style, "\n".join(f"<script>{text}</script>" for text in scripts))


def _run(whole: dict[str, Any], folder: Folder) -> dict[str, Any]:
    """A run's details with one small picture and no links."""
    small = small_picture(folder.path / whole["pictures"][0][0], RUN_WIDTH) if whole["pictures"] else ""
    pictures = [[name, small, alt] for name, _, alt in whole["pictures"][:1] if small]
    return whole | {"pictures": pictures, "files": {}}


def _paper(whole: dict[str, Any], picture: Path) -> dict[str, Any]:
    shown = small_picture(picture, FIGURE_WIDTH) if whole["picture"] else ""
    return whole | {"picture": shown or None, "shown": shown, "files": {}}


def small_picture(path: Path, width: int) -> str:
    """A picture as an address that holds it, at most so wide; empty where it cannot be read."""
    try:
        with Image.open(path) as picture:
            if picture.width * picture.height > LARGEST:
                return ""
            flat = Image.new("RGB", picture.size, "white")
            image = picture.convert("RGBA")
            flat.paste(image, mask=image.getchannel("A"))
        flat.thumbnail((width, 4 * width))
        content = io.BytesIO()
        flat.save(content, "WEBP", quality=QUALITY, method=4)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return ""
    return f"data:image/webp;base64,{base64.b64encode(content.getvalue()).decode('ascii')}"
