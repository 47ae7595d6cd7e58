"""Pairs images with cameras and masks with images: by name, or by order.

Both rules pair all, or raise an error that lists five names of each side.
"""

import re
from collections.abc import Collection, Iterable, Mapping
from functools import cache
from itertools import pairwise
from os.path import normpath
from pathlib import Path, PurePosixPath
from unicodedata import normalize

from renderers.checks import BadInput

IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
MAX_LISTED_NAMES = 5


def images_in(folder: Path, *, deep: bool = False) -> dict[str, Path]:
    """The images of a folder by name, in string order; `deep` adds those of inner folders, by their paths in it."""
    if not folder.is_dir():
        return {}
    files = folder.rglob("*") if deep else folder.iterdir()
    return dict(sorted((file.relative_to(folder).as_posix(), file) for file in files if is_image(file)))


def is_image(file: Path) -> bool:
    """Whether a file is an image by its name; hidden files, such as a Mac's `._NAME`, are none."""
    return file.suffix.lower() in IMAGES and not file.name.startswith(".") and file.is_file()


def first_images(folder: Path, *names: str) -> dict[str, Path]:
    """The images of the first of the named folders that has images."""
    return next((images for name in names if (images := images_in(folder / name))), {})


def pair_by_order(names: Iterable[str], count: int, where: str) -> tuple[list[str], tuple[str, ...]]:
    """Pairs images with cameras that have no names: the i-th camera has the i-th image in string order.

    Args:
        names: of the images, without folders; may be empty.
        where: the file of the cameras, for messages.

    Returns:
        The names in string order, and a note if their numbers have another order.

    Raises:
        BadInput: the numbers of images and cameras differ.
    """
    ordered = sorted(names)
    if ordered and len(ordered) != count:
        more = f"{ordered[count]} has no camera: " if len(ordered) > count else ""
        raise BadInput(
            f"{more}{where} has {count} cameras, number 0 to {count - 1}, and there are {len(ordered)} images "
            f"({_first_names(ordered)}), which are paired by the order of their names: add the missing images or "
            "cameras, or remove the images without one"
        )
    swapped = next((pair for pair in pairwise(ordered) if natural_key(pair[0]) > natural_key(pair[1])), None)
    if swapped is None:
        return ordered, ()
    pairing = f"{count} images, paired with cameras by name order: {swapped[0]} before {swapped[1]}"
    return ordered, (f"{pairing}; if cameras follow the numbers, give these leading zeros",)


def natural_key(name: str) -> tuple[tuple[int, str], ...]:
    """A key for sorting, by which image 10 comes after image 9."""
    return tuple((int(word), "") if word.isdecimal() else (-1, word) for word in re.split(r"(\d+)", name))


def pair_by_name(names: Collection[str], others: Collection[str]) -> dict[str, str]:
    """Pairs names with equal other names, or with others of the same `normalised_stem`; empty if stems repeat."""
    for key in (str, normalised_stem):
        keys, other_keys = {key(name): name for name in names}, {key(name): name for name in others}
        if key is normalised_stem and (len(keys) < len(names) or len(other_keys) < len(others)):
            return {}
        if key is normalised_stem or keys.keys() <= other_keys.keys():
            return {name: other_keys[stem] for stem, name in keys.items() if stem in other_keys}
    return {}


def normalised_stem(name: str) -> str:
    """A name in lower case without the suffixes of images; a number without leading zeros."""
    path = PurePosixPath(normalize("NFC", name).lower())  # a Mac stores accents apart from their letters
    while path.suffix in (*IMAGES, ".exr"):  # COLMAP has NAME.jpg.png
        path = path.with_suffix("")
    return str(int(str(path))) if str(path).isdecimal() else str(path)


def find_masks(
    folder: Path, images: Mapping[str, Path], *, sorted_too: bool = False
) -> tuple[dict[str, Path], tuple[str, ...]]:
    """The mask of each image, by the image's name, from the folder `mask` or `masks`; and a note on pairs by order.

    Args:
        sorted_too: pair by string order if no names are equal; for formats that pair in this way.

    Raises:
        BadInput: there are masks, but an image has none.
    """
    base = next((folder / name for name in ("mask", "masks") if images_in(folder / name, deep=True)), None)
    if base is None or not images:
        return {}, ()
    masks, notes = images_in(base, deep=True), ()
    pairs = pair_by_name(images, masks)
    if not pairs and sorted_too and len(images) == len(masks):
        pairs = dict(zip(sorted(images), masks, strict=True))
        notes = (f"{len(images)} images; {len(masks)} masks by the order of their names",)
    if unpaired := [name for name in images if name not in pairs]:
        unused = [name for name in masks if name not in pairs.values()]
        raise BadInput(
            f"{images[unpaired[0]]} has no mask in {base}, for {len(images)} images ({_first_names(images)}) and "
            f"{len(masks)} masks ({_first_names(masks)}){f', of which {unused[0]} has no image' if unused else ''}: "
            "add it, name masks as their images, or remove the folder of masks"
        )
    return {name: masks[mask] for name, mask in pairs.items()}, notes


def find_images(names: Iterable[str], base: Path) -> tuple[dict[str, Path], tuple[str, ...]]:
    """The image files of paths that a file of cameras names, and a note if paths or suffixes differ.

    Paths are relative to `base`, with / or \\. Their suffix may be missing or differ. If leading folders come from
    another machine, they are skipped: the number of skipped folders that finds the most images counts.

    Raises:
        BadInput: two paths lead to one file.
    """
    paths = {name: PurePosixPath(name.replace("\\", "/")).parts for name in names}
    listing, files, skipped = cache(images_in), dict[str, Path](), 0
    for skip in range(max(map(len, paths.values()), default=0)):
        tails = {name: Path(normpath(base.joinpath(*path[skip:]))) for name, path in paths.items() if len(path) > skip}
        existing = {name: file for name, tail in tails.items() if (file := _find_image(tail, listing(tail.parent)))}
        if len(existing) > len(files):
            files, skipped = existing, skip
    if not files:
        return {}, ()
    by_file = {file: name for name, file in files.items()}
    if repeated := [(name, by_file[file], file) for name, file in files.items() if by_file[file] != name]:
        name, other, file = repeated[0]
        raise BadInput(f"{name} and {other} have cameras, and are one file, {file}: name each image once")
    if skipped:
        folders = PurePosixPath(*paths[next(iter(files))][:skipped])
        return files, (f"images by the ends of their paths, without {folders}",)
    suffixes = [(PurePosixPath(paths[name][-1]).suffix, file.suffix) for name, file in files.items()]
    differing = [pair for pair in suffixes if pair[0].lower() in IMAGES and pair[0] != pair[1]]
    return files, tuple(f"images with the suffix {stored}, named with {named}" for named, stored in differing[:1])


def _find_image(file: Path, images: Mapping[str, Path]) -> Path | None:
    """The file itself, or the image of its folder with the same `normalised_stem`.

    If several match: a name with an image's suffix takes none, another name takes the first kind of `IMAGES`.
    """
    if is_image(file):
        return file
    matches = [image for name, image in images.items() if normalised_stem(name) == normalised_stem(file.name)]
    if len(matches) > 1 and file.suffix.lower() in IMAGES:
        return None
    return min(matches, key=lambda image: IMAGES.index(image.suffix.lower()), default=None)


def unpaired_note(what: str, names: Collection[str]) -> tuple[str, ...]:
    """A note on cameras without an image, or on images without a camera; empty without names."""
    partners = {"image": "cameras", "camera": "images"}[what]
    return (f"no {what} for {len(names)} of the {partners}, such as {next(iter(names))}",) if names else ()


def _first_names(names: Collection[str]) -> str:
    return ", ".join([*names][:MAX_LISTED_NAMES]) + (", ..." if len(names) > MAX_LISTED_NAMES else "")
