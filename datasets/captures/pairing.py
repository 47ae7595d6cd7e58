"""Which image belongs to which camera, and which mask to which image: by name, or by order.

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
LISTED = 5  # names of a list in a message


def images_in(folder: Path, *, deep: bool = False) -> dict[str, Path]:
    """The images of a folder by name, in string order; hidden ones, as a Mac adds (`._NAME`), are none.

    Args:
        deep: with those of its folders, by their paths in it.
    """
    if not folder.is_dir():
        return {}
    files = folder.rglob("*") if deep else folder.iterdir()
    return dict(sorted((file.relative_to(folder).as_posix(), file) for file in files if is_image(file)))


def is_image(file: Path) -> bool:
    """Whether a file is an image by its name."""
    return file.suffix.lower() in IMAGES and not file.name.startswith(".") and file.is_file()


def first_images(folder: Path, *names: str) -> dict[str, Path]:
    """The images of the first of these folders that has any."""
    return next((images for name in names if (images := images_in(folder / name))), {})


def by_order(names: Iterable[str], count: int, where: str) -> tuple[list[str], tuple[str, ...]]:
    """The images of cameras that have no names: the i-th camera has the i-th image in string order.

    Args:
        names: of the images, without folders; none where there are no images yet.
        where: the file of the cameras, for messages.

    Returns:
        The names in this order, and a note where their numbers have another order.

    Raises:
        BadInput: where there are more or fewer images than cameras.
    """
    ordered = sorted(names)
    if ordered and len(ordered) != count:
        more = f"{ordered[count]} has no camera: " if len(ordered) > count else ""
        raise BadInput(
            f"{more}{where} has {count} cameras, number 0 to {count - 1}, and there are {len(ordered)} images "
            f"({_some(ordered)}), which are paired by the order of their names: add the missing images or cameras, or "
            "remove the images without one"
        )
    swapped = next((pair for pair in pairwise(ordered) if natural(pair[0]) > natural(pair[1])), None)
    if swapped is None:
        return ordered, ()
    pairing = f"{count} images, paired with cameras by name order: {swapped[0]} before {swapped[1]}"
    return ordered, (f"{pairing}; if cameras follow the numbers, give these leading zeros",)


def natural(name: str) -> tuple[tuple[int, str], ...]:
    """A key by which image 10 comes after image 9."""
    return tuple((int(some), "") if some.isdecimal() else (-1, some) for some in re.split(r"(\d+)", name))


def by_name(names: Collection[str], others: Collection[str]) -> dict[str, str]:
    """For each name the other one that is the same, or the same but for `bare`; none where several are."""
    for key in (str, bare):
        keys, other_keys = {key(name): name for name in names}, {key(name): name for name in others}
        if key is bare and (len(keys) < len(names) or len(other_keys) < len(others)):
            return {}
        if key is bare or keys.keys() <= other_keys.keys():
            return {name: other_keys[same] for same, name in keys.items() if same in other_keys}
    return {}


def bare(name: str) -> str:
    """A name without the suffixes of images, in small letters; a number without leading zeros."""
    path = PurePosixPath(normalize("NFC", name).lower())  # a Mac parts accents from their letters
    while path.suffix in (*IMAGES, ".exr"):  # COLMAP has NAME.jpg.png
        path = path.with_suffix("")
    return str(int(str(path))) if str(path).isdecimal() else str(path)


def masks_of(
    folder: Path, images: Mapping[str, Path], *, sorted_too: bool = False
) -> tuple[dict[str, Path], tuple[str, ...]]:
    """The mask of each image, by the image's name, from the folder `mask` or `masks`; and a note on pairs by order.

    Args:
        sorted_too: whether the format pairs them by string order, which is taken where no name is the same.

    Raises:
        BadInput: where there are masks, but an image has none.
    """
    base = next((folder / name for name in ("mask", "masks") if images_in(folder / name, deep=True)), None)
    if base is None or not images:
        return {}, ()
    masks, notes = images_in(base, deep=True), ()
    pairs = by_name(images, masks)
    if not pairs and sorted_too and len(images) == len(masks):
        pairs = dict(zip(sorted(images), masks, strict=True))
        notes = (f"{len(images)} images; {len(masks)} masks by the order of their names",)
    if lost := [name for name in images if name not in pairs]:
        unused = [name for name in masks if name not in pairs.values()]
        raise BadInput(
            f"{images[lost[0]]} has no mask in {base}, for {len(images)} images ({_some(images)}) and {len(masks)} "
            f"masks ({_some(masks)}){f', of which {unused[0]} has no image' if unused else ''}: add it, name masks as "
            "their images, or remove the folder of masks"
        )
    return {name: masks[mask] for name, mask in pairs.items()}, notes


def located(names: Iterable[str], base: Path) -> tuple[dict[str, Path], tuple[str, ...]]:
    """The image files of paths that a file of cameras names, and a note where paths or suffixes are others.

    Paths are relative to `base`, with / or \\; their suffix may be left out, or be another one. Where no image is at
    these paths, leading folders are left out, as those of another machine.

    Raises:
        BadInput: where two paths lead to one file.
    """
    paths = {name: PurePosixPath(name.replace("\\", "/")).parts for name in names}
    listing, files, left = cache(images_in), dict[str, Path](), 0
    for skip in range(max(map(len, paths.values()), default=0)):
        tails = {name: Path(normpath(base.joinpath(*path[skip:]))) for name, path in paths.items() if len(path) > skip}
        some = {name: file for name, tail in tails.items() if (file := _existing(tail, listing(tail.parent)))}
        if len(some) > len(files):
            files, left = some, skip
    if not files:
        return {}, ()
    by_file = {file: name for name, file in files.items()}
    if twice := [(name, by_file[file], file) for name, file in files.items() if by_file[file] != name]:
        name, other, file = twice[0]
        raise BadInput(f"{name} and {other} have cameras, and are one file, {file}: name each image once")
    if left:
        folders = PurePosixPath(*paths[next(iter(files))][:left])
        return files, (f"images by the ends of their paths, without {folders}",)
    suffixes = [(PurePosixPath(paths[name][-1]).suffix, file.suffix) for name, file in files.items()]
    others = [pair for pair in suffixes if pair[0].lower() in IMAGES and pair[0] != pair[1]]
    return files, tuple(f"images with the suffix {stored}, named with {named}" for named, stored in others[:1])


def _existing(file: Path, images: Mapping[str, Path]) -> Path | None:
    """The file itself, or the one image of its folder that has the same name but for `bare`.

    Of several the first kind of image, where the name has no suffix.
    """
    if is_image(file):
        return file
    same = [image for name, image in images.items() if bare(name) == bare(file.name)]
    if len(same) > 1 and file.suffix.lower() in IMAGES:
        return None
    return min(same, key=lambda image: IMAGES.index(image.suffix.lower()), default=None)


def without(what: str, names: Collection[str]) -> tuple[str, ...]:
    """A note on cameras without an image, or on images without a camera, by their names; none where there is none."""
    those = {"image": "cameras", "camera": "images"}[what]
    return (f"no {what} for {len(names)} of the {those}, such as {next(iter(names))}",) if names else ()


def _some(names: Collection[str]) -> str:
    """The first names of a list."""
    return ", ".join([*names][:LISTED]) + (", ..." if len(names) > LISTED else "")
