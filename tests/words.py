"""`python -m tests.words`, a part of `make lint`: vague names, constants explained by comments, unclear prose."""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("renderers", "datasets", "bench")
VAGUE_NAMES = {
    "found", "known", "place", "one", "part", "own", "given", "of", "at", "told", "there",
    "beside", "said", "asked", "some", "every", "begun", "done", "whole", "seen",
    "BESIDE", "GREY", "LEAST", "MOST", "FEWEST", "FAR", "NEAR", "SAME", "MARGIN", "CHUNK",
    "SEEN", "KEPT", "FIRST", "LONGEST", "HALF", "APART", "WORDS", "OWN",
}  # fmt: skip
# A comment that begins so is the missing half of the constant's name.
EXPLAINED = re.compile(r"^ *([A-Z][A-Z0-9_, ]*)(?::[^=\n]*)? = [^#\n]*# *(?:of|by|that|in)\b", re.MULTILINE)
UNCLEAR = re.compile(
    r"(?i)\b(told|tells?|beside|those of|say so|speaks? of|what (?:is|has|it|came)|as \w+ has it|anew|likewise|"
    r"the same of|judged by|stands? apart|but for|where there (?:is|are) none)\b"
)
NOT_PROSE = re.compile(r"^```[\s\S]*?^```$|^ {4}.*$|<[^>]*>|`[^`]*`|\]\([^)]*\)", re.MULTILINE)
SENTENCE_END = re.compile(r"(?<=[.!?])\s+|\n\s*\n|\n(?=#|\s*[-*] |\s*\d+\. )|\||^#.*$", re.MULTILINE)
MAX_WORDS = 25  # per sentence


def faults_of_code(source: str) -> Iterator[str]:
    """The vague names that a module binds, and its constants whose meaning is in their comment."""
    tree = ast.parse(source)
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    fields = {line.target for node in classes for line in node.body if isinstance(line, ast.AnnAssign)}  # keys of files
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node not in fields:
            name = node.id
        else:
            name = node.arg if isinstance(node, ast.arg) else ""
        if name in VAGUE_NAMES:
            yield f"line {getattr(node, 'lineno', 0)}: {name!r} says nothing: name the quantity"
    for match in EXPLAINED.finditer(source):
        yield f"{match[1]!r} needs its comment: put its meaning and unit into the name"


def faults_of_prose(text: str) -> Iterator[str]:
    """The unclear phrases and the long sentences of a Markdown file."""
    prose = NOT_PROSE.sub("", text)
    yield from (f"unclear: {match[0]!r}" for match in UNCLEAR.finditer(prose))
    for sentence in SENTENCE_END.split(prose):
        words = re.findall(r"\w(?:\S*\w)?", sentence)
        if len(words) > MAX_WORDS:
            yield f"{len(words)} words, at most {MAX_WORDS}: {' '.join(words)}"


def main() -> int:
    """Prints the faults of all modules and README files; gives the exit status."""
    modules = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    folders = (*PACKAGES, "conf", "results")
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / folder / "README.md" for folder in folders)]
    faults = [f"{path.relative_to(ROOT)}: {fault}" for path in modules for fault in faults_of_code(path.read_text())]
    faults += [f"{path.relative_to(ROOT)}: {fault}" for path in pages for fault in faults_of_prose(path.read_text())]
    print(*faults, sep="\n", end="\n" if faults else "")
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
