"""Random names of images, cameras and masks: the pairs follow the rules, or the names are refused."""

import re
from pathlib import Path
from unicodedata import normalize

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from datasets.files.captures.pairing import find_images, find_masks, pair_by_name, pair_by_order
from datasets.files.own_photographs import ReadSettings, read_capture
from renderers.checks import BadInput
from tests.looped import each
from tests.made_photographs import PLAIN, READ, colmap, idr, llff, off, renamed

PREFIXES = st.sampled_from(["", "r_", "IMG_2023_", "cam1_a_", "view 3 (4) "])
WIDTHS = st.sampled_from([1, 3, 6])


def write(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


@given(PREFIXES, WIDTHS, st.integers(0, 5), st.integers(3, 30), st.randoms())
def test_cameras_are_those_of_the_names_in_string_order(prefix, width, start, count, random):
    names = sorted(f"{prefix}{str(start + i).zfill(width)}.png" for i in range(count))
    assert pair_by_order(random.sample(names, count), count, "file")[0] == names
    assert pair_by_order([], count, "file") == ([], ())


@given(PREFIXES, WIDTHS, st.integers(3, 30), st.integers(1, 40))
def test_different_numbers_of_images_and_cameras_are_refused_with_five_names(prefix, width, count, images):
    names = sorted(f"{prefix}{str(i).zfill(width)}.png" for i in range(images))
    if images == count:
        return
    first = ", ".join(names[:5]) + (", ..." if images > 5 else "")
    words = f"file has {count} cameras, number 0 to {count - 1}, and there are {images} images ({first})"
    with pytest.raises(BadInput) as caught:
        pair_by_order(names, count, "file")
    assert str(caught.value).startswith(f"{names[count]} has no camera: {words}" if images > count else words)


MASKS = {
    "NAME": lambda stem, suffix: f"{stem}{suffix}",
    "NAME.ext.png": lambda stem, suffix: f"{stem}{suffix}.png",
    "NAME with another suffix": lambda stem, suffix: f"{stem}.TIFF",
    "another name": lambda stem, suffix: f"mask_{stem}_m.png",
}


@given(
    st.sets(st.from_regex(r"[a-c]{1,2}_?[0-9]{1,3}(_of_12)?", fullmatch=True), min_size=3, max_size=12),
    st.sampled_from([".png", ".jpg", ".JPEG"]),
    st.sampled_from([*MASKS]),
    st.randoms(),
)
def test_masks_are_those_of_their_images(stems, suffix, rule, random):
    """The rule also holds if last numbers are equal."""
    pairs = {stem + suffix: MASKS[rule](stem, suffix) for stem in stems}
    masks = random.sample([*pairs.values()], len(pairs))
    assert pair_by_name([*pairs], masks) == ({} if rule == "another name" else pairs)


@each("images, masks, pairs", [
    (["0.png", "9.png"], ["009.png", "000.png"], {"0.png": "000.png", "9.png": "009.png"}),  # leading zeros are ignored
    (["cam1_0.png", "cam1_1.png"], ["cam2_0.png", "cam2_1.png"], {}),
    (["a.png", "a.jpg"], ["a.tif"], {}), (["1.png", "2.png"], ["01.png", "001.png", "2.png"], {}),  # ambiguous
])  # fmt: skip
def test_names_that_differ_in_more_than_zeros_or_are_ambiguous_give_no_pairs(images, masks, pairs):
    assert pair_by_name(images, masks) == pairs


def test_masks_that_are_not_one_to_one_are_refused_with_both_lists(tmp_path):
    images = {name: tmp_path / name for name in ("a_0.png", "a_1.png", "a_2.png", "b_0.png")}
    write(tmp_path / "mask", "m_0.png", "m_1.png", "m_2.png", "._m_0.png")
    with pytest.raises(BadInput, match=re.escape("(a_0.png, a_1.png, a_2.png, b_0.png) and 3 masks (m_0.png, ")):
        find_masks(tmp_path, images)
    write(tmp_path / "mask", "n_0.png")
    with pytest.raises(BadInput, match="has no mask"):
        find_masks(tmp_path, images)
    masks, notes = find_masks(tmp_path, images, sorted_too=True)
    assert masks["b_0.png"].name == "n_0.png" and notes == ("4 images; 4 masks by the order of their names",)


MANY_EXAMPLES = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25)


@MANY_EXAMPLES
@given(
    st.sampled_from(["", "./", "images/", "C:\\scans\\me\\images\\", "/home/me/images/", "..\\images\\"]),
    st.booleans(),
    st.sampled_from([".png", ".PNG", ".jpg", ""]),
)
def test_images_are_matched_to_paths_of_other_machines(tmp_path, before, windows, suffix):
    names = ["cam 1/0.1", "cam 1/1", "cam2/0.1"]
    base = tmp_path / "images" if "images" not in before or "." in before else tmp_path
    write(tmp_path, *(f"images/{name}.png" for name in names), "images/._1.png")
    paths = {before + name + suffix: name for name in names}
    paths = {path.replace("/", "\\") if windows else path: name for path, name in paths.items()}
    files, note = find_images([*paths], base)
    relative = {path: file.relative_to(tmp_path / "images").as_posix() for path, file in files.items()}
    assert relative == {path: f"{name}.png" for path, name in paths.items()} or (suffix == "" and len(files) < 3)
    assert ("without" in str(note)) == (before[:1] in ("C", "/")) or suffix == ""


@pytest.mark.parametrize("forms", [("NFC", "NFD"), ("NFD", "NFC")])
def test_accents_match_in_each_unicode_form(tmp_path, forms):
    stored, requested = (normalize(form, "\u00e9 1.png") for form in forms)
    write(tmp_path, stored, "e 1.png")
    assert find_images([requested], tmp_path)[0] == {requested: tmp_path / stored}


def test_two_paths_to_one_file_are_refused(tmp_path):
    write(tmp_path, "0.png")
    with pytest.raises(BadInput, match=r"a/0.png and b/0.png have cameras, and are one file"):
        find_images(["a/0.png", "b/0.png"], tmp_path)


# Whole folders


@each("format, folder", [(idr, "image"), (llff, "images_4")])
def test_names_without_zeros_are_paired_in_string_order(tmp_path, format, folder):
    tmp_path = tmp_path / folder
    tmp_path.mkdir()
    format(tmp_path)
    order = sorted(f"{i}.png" for i in range(8, 18))
    for subfolder in (folder, "mask"):
        renamed(tmp_path / subfolder, lambda i: order[i])
    capture = read_capture(tmp_path, READ)
    assert [shot.name for shot in capture.shots] == order
    assert capture.notes[0].startswith("10 images, paired with cameras by name order: 17.png before 8.png; if cameras")
    (tmp_path / folder / "12.png").unlink()
    with pytest.raises(BadInput, match=r"10 cameras, .* 9 images \(10.png, 11.png, 13.png, 14.png, 15.png, \.\.\.\)"):
        read_capture(tmp_path, READ)


@pytest.mark.parametrize("named", ["a b (1)/{0}", "C:\\me\\images\\{0}", "/home/me/images/{0}", "left/{0}"])
def test_names_with_folders_blanks_and_paths_of_other_machines(tmp_path, named):
    colmap(tmp_path)
    inner = named.format("") if named[0] not in "C/" else ""
    if inner:
        for subfolder in ("images", "mask"):
            (tmp_path / subfolder).rename(tmp_path / "moved")
            (tmp_path / subfolder).mkdir()
            (tmp_path / "moved").rename(tmp_path / subfolder / inner.strip("/"))
    file = tmp_path / "sparse" / "0" / "images.txt"
    file.write_text(re.sub(r"(\d{3}\.png)", lambda name: named.format(name[0]), file.read_text()))
    assert off(read_capture(tmp_path, PLAIN)) < 0.01
    (tmp_path / "images").rename(tmp_path / "elsewhere")
    with pytest.raises(BadInput, match=r"none of their images, such as .*000.png; its files end with .png, .txt"):
        read_capture(tmp_path, READ)
    assert off(read_capture(tmp_path, ReadSettings(48, masks=False, images="elsewhere"))) < 0.01
