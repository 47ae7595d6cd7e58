"""Lists of shapes: the ids of a class in each split, from JSON, CSV or lines of text."""

import csv
import json
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from datasets.files.readers.text import decode, decode_with_comments, wrong_kind_message
from datasets.scene import Split

SYNSETS = {  # the classes of Choy et al. 2016, of which DeepSDF takes five
    **{"plane": "02691156", "bench": "02828884", "cabinet": "02933112", "car": "02958343", "chair": "03001627"},
    **{"display": "03211117", "lamp": "03636649", "speaker": "03691459", "rifle": "04090263", "sofa": "04256520"},
    **{"table": "04379243", "phone": "04401088", "vessel": "04530566"},
}
NAMES = {number: name for name, number in SYNSETS.items()}
SPLIT_WORDS = {Split.TRAIN: "train", Split.VALIDATION: "val", Split.TEST: "test"}  # parts of the names of lists
SPLITS = {word: split for split, word in SPLIT_WORDS.items()}
SPLITS |= {"training": Split.TRAIN, "valid": Split.VALIDATION, "validation": Split.VALIDATION, "testing": Split.TEST}
SYNSET_PATTERN = re.compile(r"\d{7,8}")  # a spreadsheet removes the leading 0
SEPARATORS = re.compile(r"[\s,;:/\\\"]+")
ID_HEADINGS, SPLIT_HEADINGS = {"id", "modelid", "model_id", "synsetid", "synset", "fullid"}, {"split", "set", "subset"}
PARTS_OF_PATHS = {"models", "model", "model_normalized"}


@dataclass(frozen=True)
class Entry:
    """A shape in a list; the synset is "" and the split None if the list does not state them."""

    name: str
    synset: str
    split: Split | None


def read_lists(file: Path, synset: str, ids: Collection[str]) -> dict[Split, list[str]]:
    """The ids of a synset in each split, from a list and the lists of the other splits in its folder.

    Args:
        ids: the shapes on disk.

    Raises:
        ValueError: a list cannot be read, or has no ids of the synset.
    """
    lists = dict[Split, dict[str, None]]()
    for file_split, path in _split_files(file).items():
        entries = _entries(path, ids)
        chosen = [entry for entry in entries if entry.synset in ("", synset)]
        if not chosen:
            has = ", ".join(dict.fromkeys(NAMES.get(entry.synset, entry.synset) for entry in entries)) or "nothing"
            raise ValueError(f"dataset.split: '{path}' has nothing of {NAMES.get(synset, synset)}, but {has}: set "
                             "dataset.synset to it, or give another list")  # fmt: skip
        for entry in chosen:
            lists.setdefault(entry.split or file_split, {})[entry.name] = None
    return {split: [*names] for split, names in lists.items()}


def _split_files(file: Path) -> dict[Split, Path]:
    """The list of each split: `file` and files of its folder with other `SPLIT_WORDS`; without any word, only test."""
    if not file.is_file():
        raise ValueError(f"dataset.split: there is no file '{file}': give a split of DeepSDF (.json) or a list (.lst)")
    match = re.search(rf"(?<![a-z])({'|'.join(SPLIT_WORDS.values())})(?![a-z])", file.name)
    if match is None:
        return {Split.TEST: file}
    names = {split: file.name[: match.start()] + word + file.name[match.end() :] for split, word in SPLIT_WORDS.items()}
    return {split: file.with_name(name) for split, name in names.items() if file.with_name(name).is_file()}


def _entries(file: Path, ids: Collection[str]) -> list[Entry]:
    content = file.read_bytes()
    try:
        if fault := wrong_kind_message(file):
            raise ValueError(fault)
        rows = _json_rows(json.loads(decode(content)), [], ids) if file.suffix == ".json" else _text_rows(content)
        return [entry for words in rows if (entry := _entry(words, ids))]
    except (ValueError, TypeError, RecursionError, csv.Error) as error:
        raise ValueError(f"dataset.split: '{file}' cannot be read as a split of DeepSDF or a list: {error}") from None


def _entry(words: list[str], ids: Collection[str]) -> Entry | None:
    """The shape of a row, which has its id and may have a synset, a split and other words in any order."""
    synsets = [word.zfill(8) for word in words if SYNSET_PATTERN.fullmatch(word)]
    synsets += [SYNSETS[word] for word in words if word in SYNSETS]
    splits = [SPLITS[word.lower()] for word in words if word.lower() in SPLITS]
    stems = [word.partition(".")[0] for word in words]
    others = [stem for stem in stems if not SYNSET_PATTERN.fullmatch(stem) and stem.lower() not in SPLITS]
    others = [stem for stem in others if stem and stem not in PARTS_OF_PATHS]
    names = [stem for stem in stems if stem in ids] or others
    return Entry(names[-1], synsets[0] if synsets else "", splits[-1] if splits else None) if names else None


def _text_rows(content: bytes) -> Iterator[list[str]]:
    """The words of each line. A line with only a split, such as `train`, is a heading: its word joins those below it.

    If the first line has headings of ids and splits, the file is a table; see `_table_rows`.
    """
    lines = [line for line in decode(content).split("\n") if line.strip()]
    headings = {*SEPARATORS.split("".join(lines[:1]).lower().strip(' "\t'))}
    has_ids, has_splits = bool(headings & ID_HEADINGS), bool(headings & SPLIT_HEADINGS)
    if has_ids and has_splits:
        yield from _table_rows(decode_with_comments(content))
        return
    section = list[str]()
    for line in lines[has_ids:]:
        words = SEPARATORS.split(line.strip(' "\t'))
        if [word.lower() for word in words if word] in [[word] for word in SPLITS]:
            section = [word for word in words if word]
        else:
            yield [*section, *words]


def _table_rows(text: str) -> Iterator[list[str]]:
    """The words of each row: of the columns of ids after other columns, and at last the split, from its column.

    Raises:
        ValueError: the column of the split has another word.
        csv.Error: a quotation mark is not closed.
    """
    lines = [line for line in text.split("\n") if line.strip() and not line.lstrip().startswith("#")]
    delimiter = next((mark for mark in ",;\t" if mark in lines[0]), " ")
    first, *rows = csv.reader(lines, delimiter=delimiter, skipinitialspace=True, strict=True)
    headings = [SEPARATORS.split(cell.strip().lower()) for cell in first]
    columns = sorted(range(len(headings)), key=lambda k: bool(ID_HEADINGS & {*headings[k]}))
    column = min((k for k in columns if SPLIT_HEADINGS & {*headings[k]}), key=lambda k: len(headings[k]))
    columns.remove(column)
    for row in rows:
        cells = [cell.strip() for cell in row] + [""] * (len(headings) - len(row))
        split = cells[column].partition("#")[0].strip()
        if split.lower() in SPLITS:
            words = [(word, cells[k]) for k in columns for word in SEPARATORS.split(cells[k])]
            words = [word for word, cell in words if not (word in SYNSETS and " " in cell)]  # "office chair" is a name
            yield [*(word for word in words if word.lower() not in SPLITS), split]
        elif any(cells):
            raise ValueError(f"its column of splits has {split!r}: write train, val or test")


def _json_rows(node: Any, path: list[str], ids: Collection[str]) -> Iterator[list[str]]:
    """The words of each shape: the keys that lead to it, texts beside them, and its own text, if it is one.

    An id may be a text of a list, or a key, with its split or numbers such as views as the value.
    """
    if isinstance(node, dict):
        texts = [value for key, value in node.items() if isinstance(value, str) and key not in ids]
        is_record = all(isinstance(value, str) and key not in ids for key, value in node.items())
        if is_record and node:
            yield [*path, *chain.from_iterable(map(SEPARATORS.split, texts))]
        for key, value in node.items():
            words = [*path, *texts, *SEPARATORS.split(key)]
            if key in ids and isinstance(value, str):
                yield [*words, value]
            elif _has_shapes(value):
                yield from _json_rows(value, words, ids)
            elif not isinstance(value, str):
                yield words
    elif isinstance(node, list):
        for item in node:
            yield from [[*path, *SEPARATORS.split(item)]] if isinstance(item, str) else _json_rows(item, path, ids)
    else:
        raise ValueError(f"it has {node!r} in the place of shapes")


def _has_shapes(value: Any) -> bool:
    """Whether a value of a table has shapes itself; an id may have numbers as its value."""
    is_list = isinstance(value, list)
    return isinstance(value, dict) or (is_list and not (value and all(isinstance(item, int | float) for item in value)))
