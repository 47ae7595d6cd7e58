"""Which image belongs to which camera, and which mask to which image: the one place that decides."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise, product, takewhile
from os.path import normpath
from pathlib import Path, PurePosixPath
from typing import TypeVar
from unicodedata import normalize

from renderers.checks import BadInput

IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
NUMBER = re.compile(r"(.*?)(\d+)(\D*)")  # the last number of a name
Key = Callable[[str], str]
Made = TypeVar("Made")


def images_in(folder: Path, *, deep: bool = False) -> dict[str, Path]:
    """The images of a folder by name, in string order; hidden ones, as a Mac adds (`._NAME`), are none.

    Args:
        deep: with those of its folders, by their paths in it.
    """
    if not folder.is_dir():
        return {}
    files = folder.rglob("*") if deep else folder.iterdir()
    found = {file.relative_to(folder).as_posix(): file for file in files if is_image(file)}
    return {name: found[name] for name in sorted(found)}


def is_image(file: Path) -> bool:
    """Whether a file is an image by its name."""
    return file.suffix.lower() in IMAGES and not file.name.startswith(".") and file.is_file()


def first_images(folder: Path, *names: str) -> dict[str, Path]:
    """The images of the first of these folders that has any."""
    return next((found for name in names if (found := images_in(folder / name))), {})


def by_order(names: Sequence[str], count: int, where: str) -> list[dict[int, str]]:
    """The image of each camera, where camera i belongs to the i-th name in string order.

    Where images are missing, the numbers in the others say which. Several answers where names allow them.

    Args:
        names: of the images, without folders.
        where: the file of the cameras, for messages.

    Raises:
        BadInput: where there are more images than cameras, or names do not tell which are missing.
    """
    ordered = sorted(names)
    if len(ordered) == count:
        return [dict(enumerate(ordered))]
    told = f"{where} has {count} cameras, and there are {len(ordered)} images ({_some(ordered)})"
    if len(ordered) > count:
        raise BadInput(f"{ordered[count]} has no camera: {told}; remove the images without one, or add their cameras")
    if not ordered:
        return [{}]
    found = _numbered(ordered, count)
    if not 0 < len(found) <= 2:
        raise BadInput(f"{told}: the names do not tell which images are missing; add them, or remove their cameras")
    return found


def made(
    answers: Sequence[Mapping[int, str]], count: int, make: Callable[[int, str], Made]
) -> tuple[tuple[Made, ...], tuple[Made, ...], tuple[str, ...]]:
    """What is made of the camera's number and the image's name, in the first answer of `by_order` and in the second.

    With notes on an unusual order, and on images that are missing.
    """
    found = [tuple(make(i, name) for i, name in sorted(places.items())) for places in answers]
    names, unused = sorted(answers[0].values()), [f"camera {i}" for i in range(count) if i not in answers[0]]
    notes = without("image", unused) if len(answers) == 1 else (f"no image for {len(unused)} of the cameras",)
    if names != sorted(names, key=natural):
        one, other = next(pair for pair in pairwise(names) if natural(pair[0]) > natural(pair[1]))
        told = f"{len(names)} images, paired with cameras by name order: {one} before {other}"
        notes = (f"{told}; if cameras follow the numbers, give these leading zeros", *notes)
    return found[0], found[1] if len(found) > 1 else (), notes


def natural(name: str) -> tuple[tuple[int, str], ...]:
    """A key by which image 10 comes after image 9."""
    parts = re.split(r"(\d+)", name)
    return tuple((int(part), "") if part.isdecimal() else (-1, part) for part in parts)


def _numbered(names: Sequence[str], count: int) -> list[dict[int, str]]:
    """The places of names among `count` names that differ by consecutive numbers alone; none where they do not."""
    parts = [match.groups() for name in names if (match := NUMBER.fullmatch(Path(name).stem))]
    ends = {(before, after, Path(name).suffix) for name, (before, _, after) in zip(names, parts, strict=False)}
    if len(parts) < len(names) or len(ends) != 1:
        return []
    (before, after, suffix), digits = ends.pop(), [number for _, number, _ in parts]
    width, values = min(map(len, digits)), [int(number) for number in digits]
    if any(number != str(int(number)).zfill(width) for number in digits):
        return []
    least, most = min(values), max(values)
    starts = [start for start in {0, 1, least} if start <= least and most < start + count]
    if starts == [least] and least > 1 and most - least + 1 < count:  # nothing says that the first is there
        return []
    zeros = any(number.startswith("0") for number in digits if len(number) > 1)
    found = []
    for start, zeroed in product(starts, {width} if zeros else {width, 1}):  # 10 and 11 may follow 09, or 9
        every = sorted(f"{before}{str(start + i).zfill(zeroed)}{after}{suffix}" for i in range(count))
        places = {every.index(name): name for name in names}
        found += [places] if places not in found else []
    return found


def paired(wanted: Sequence[str], found: Sequence[str]) -> tuple[dict[str, str], str]:
    """For each wanted name one that was found, by the first rule that has all; and that rule, in words.

    The rules: the name; `NAME.ext.png`; the same name with another suffix; one common prefix or suffix. Where none
    has all, the pairs of the one that has most of them.
    """
    best: tuple[dict[str, str], str] = ({}, "")
    for rule, key, other in _rules(wanted, found):
        keys, there = [key(name) for name in wanted], [other(name) for name in found]
        if len({*keys}) < len(keys) or len({*there}) < len(there):
            continue
        known = dict(zip(there, found, strict=True))
        pairs = {name: known[one] for name, one in zip(wanted, keys, strict=True) if one in known}
        if len(pairs) == len(wanted):
            return pairs, rule
        if len(pairs) > len(best[0]):
            best = pairs, rule
    return best


SAME, FULL, STEM, AFFIX = "NAME", "NAME.ext.png", "NAME with another suffix", "a common prefix or suffix"


def _rules(wanted: Sequence[str], found: Sequence[str]) -> list[tuple[str, Key, Key]]:
    """Names of rules, and the keys by which wanted and found names are the same."""
    rules: list[tuple[str, Key, Key]] = [(SAME, str, str), (FULL, str, _stem), (STEM, _stem, _stem)]
    cut, other = _affixes(wanted), _affixes(found)
    digits = [set(re.findall(r"\d+", " ".join(ends))) for ends in (cut, other)]
    if all(digits) and digits[0] != digits[1]:  # cam1_000 is not cam2_000
        return rules
    return [*rules, (AFFIX, lambda name: _core(name, cut), lambda name: _core(name, other))]


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(""))


def _affixes(names: Sequence[str]) -> tuple[str, str]:
    """What all stems begin and end with, but no part of a number."""
    stems = [_stem(name) for name in names]
    before = re.sub(r"\d+$", "", _beginning(stems))
    after = _beginning([stem[len(before) :][::-1] for stem in stems])[::-1]
    return before, re.sub(r"^\d+", "", after)


def _beginning(names: Sequence[str]) -> str:
    """What all names begin with: the first and the last in string order do."""
    both = zip(min(names, default=""), max(names, default=""), strict=False)
    return "".join(one for one, _ in takewhile(lambda pair: pair[0] == pair[1], both))


def _core(name: str, affixes: tuple[str, str]) -> str:
    """A stem without these; of a number its value."""
    before, after = affixes
    stem = _stem(name)
    core = stem[len(before) : len(stem) - len(after)]
    return str(int(core)) if core.isdecimal() else core


def masks_of(
    folder: Path, images: Mapping[str, Path], *, sorted_too: bool = False
) -> tuple[dict[str, Path], tuple[str, ...]]:
    """The mask of each image, by the image's name, from the folder `mask` or `masks`; and a note on an unusual rule.

    Args:
        sorted_too: whether the format pairs them by string order, which is taken where names do not tell.

    Raises:
        BadInput: where there are masks, but an image has none.
    """
    place = next((folder / name for name in ("mask", "masks") if images_in(folder / name, deep=True)), None)
    if place is None or not images:
        return {}, ()
    masks = images_in(place, deep=True)
    pairs, rule = paired([*images], [*masks])
    if not pairs and sorted_too and len(images) == len(masks):
        pairs, rule = dict(zip(sorted(images), sorted(masks), strict=True)), "the order of their names"
    if lost := [name for name in images if name not in pairs]:
        unused = [name for name in masks if name not in pairs.values()]
        raise BadInput(
            f"{images[lost[0]]} has no mask in {place}, for {len(images)} images ({_some(images)}) and {len(masks)} "
            f"masks ({_some(masks)}){f', of which {unused[0]} has no image' if unused else ''}: add it, name masks as "
            "their images, or remove the folder of masks"
        )
    plain = rule in (SAME, STEM) or _padded(pairs)
    notes = () if plain else (f"{len(images)} images; {len(pairs)} masks by {rule}",)
    return {name: masks[mask] for name, mask in pairs.items()}, notes


def _padded(pairs: Mapping[str, str]) -> bool:
    """Whether names differ by zeros before a number alone: 000001.png and 001.png."""
    return all(_stem(name).isdecimal() and _stem(mask).isdecimal() for name, mask in pairs.items())


def located(names: Iterable[str], base: Path) -> tuple[dict[str, Path], tuple[str, ...]]:
    """The image files of paths that a file of cameras names, and a note on how they were found, if that is unusual.

    Paths are relative to `base`, with / or \\; their suffix may be left out, or be another one. Where none is there,
    leading folders are left out, as those of another machine.

    Raises:
        BadInput: where two paths lead to one file.
    """
    parts = {name: PurePosixPath(name.replace("\\", "/")).parts for name in names}
    listed: dict[Path, dict[str, Path]] = {}
    found: dict[str, Path] = {}
    left = 0
    for skip in range(max(map(len, parts.values()), default=0)):
        tails = {name: Path(normpath(base.joinpath(*some[skip:]))) for name, some in parts.items() if len(some) > skip}
        there = {name: file for name, tail in tails.items() if (file := _existing(tail, listed))}
        if len(there) > len(found):
            found, left = there, skip
    by_file: dict[Path, str] = {}
    for name, file in found.items():
        if (other := by_file.setdefault(file, name)) != name:
            raise BadInput(f"{other} and {name} have cameras, and are one file, {file}: name each image once")
    for name, file in found.items():
        if left:
            return found, (f"images by the ends of their paths, without {PurePosixPath(*parts[name][:left])}",)
        suffix = PurePosixPath(parts[name][-1]).suffix
        if suffix.lower() in IMAGES and suffix != file.suffix:
            return found, (f"images with the suffix {file.suffix}, named with {suffix}",)
    return found, ()


def _existing(file: Path, listed: dict[Path, dict[str, Path]]) -> Path | None:
    """The file itself, or the one image of its folder with the same name and another suffix, or written otherwise."""
    if is_image(file):
        return file
    if file.parent not in listed:
        listed[file.parent] = images_in(file.parent)
    there = listed[file.parent]
    stem = _stem(file.name) if file.suffix.lower() in IMAGES else file.name
    for same in ((lambda name: _stem(name) == stem), (lambda name: _plain(_stem(name)) == _plain(stem))):
        found = [path for name, path in there.items() if same(name)]
        if found and (len(found) == 1 or stem == file.name):  # of a name without suffix the first kind
            return min(found, key=lambda path: IMAGES.index(path.suffix.lower()))
    return None


def _plain(name: str) -> str:
    """A name in lower case, with accents as Linux writes them: a Mac parts them from their letters."""
    return normalize("NFC", name).lower()


def without(what: str, names: Sequence[str]) -> tuple[str, ...]:
    """A note on cameras without an image, or on images without a camera, by their names; none where there is none."""
    of = {"image": "cameras", "camera": "images"}[what]
    return (f"no {what} for {len(names)} of the {of}, such as {names[0]}",) if names else ()


def _some(names: Iterable[str]) -> str:
    """The first names of a list, and its last."""
    listed = [*names]
    return ", ".join(listed) if len(listed) < 4 else f"{listed[0]}, {listed[1]} ... {listed[-1]}"
