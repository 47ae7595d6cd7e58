"""Reads the page that `write_index` writes: its shell, and the data of its scripts."""

import json
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

HEAD = "implicitBench.receive("


class Shell(HTMLParser):
    """The addresses, the anchors, the tags and the text of `index.html`."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links, self.anchors, self.tags, self.text = [], [], [], ""
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.links += [value for name, value in attributes if name in ("href", "src")]
        self.anchors += [value for name, value in attributes if name == "id"]

    def handle_data(self, data):
        self.text += data


def script(path: Path) -> tuple[str, str, Any]:
    """The kind, the key and the data of a script, which holds nothing else."""
    text = path.read_text(encoding="ascii")
    assert text.startswith(HEAD) and text.endswith(");\n") and text.count("\n") == 1
    assert not set("<>&\u2028\u2029") & set(text)
    return tuple(json.loads(f"[{text[len(HEAD) : -3]}]"))


class Page:
    """What the page of a results folder shows."""

    def __init__(self, results: Path, beginning: int = 2) -> None:
        self.results, self.data, self.beginning = results, results / "page" / "data", beginning
        self.shell = Shell(results / "index.html")
        lists = {name: self.read("list", name) for name in ("about", "papers", "runs")}
        self.about, self.papers, self.runs = lists["about"], lists["papers"], lists["runs"]
        self.folders = self.runs["folder"]

    def read(self, kind: str, key: str) -> Any:
        found = script(self.data / kind / f"{key}.js")
        assert found[:2] == (kind, key)
        return found[2]

    def text(self, column: str) -> list[str]:
        """A column of texts."""
        coded = self.runs["texts"][column]
        return [coded["values"][code] for code in coded["codes"]]

    def run(self, folder: str) -> dict[str, Any]:
        """The details of a run."""
        key = self.runs["key"][self.folders.index(folder)]
        return self.read("run", key[: self.beginning])[key]

    def paper(self, name: str) -> dict[str, Any]:
        """The details of a table or figure."""
        return self.read("paper", next(paper["key"] for paper in self.papers if paper["name"] == name))
