"""BlendedMVS and MVSNet: one file per image in `cams`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from datasets.files.captures.frames import Format, Frame, Layout, homogeneous_matrix
from datasets.files.captures.pairing import find_masks, first_images, pair_by_name, unpaired_note
from renderers.checks import BadInput


def read_layout(folder: Path, files: Sequence[Path], masked: bool) -> Layout:
    """One file per image: world_to_camera, K, and the depth range."""
    cameras = {file.name[: -len("_cam.txt")]: file for file in files}
    images = first_images(folder, "blended_images", "images")
    images = {name: file for name, file in images.items() if not file.stem.endswith("_masked")}
    pairs = pair_by_name(cameras, images)
    if lacking := [name for name in images if name not in pairs.values()]:
        raise BadInput(f"{images[lacking[0]]} has no camera: there is no cams/{Path(lacking[0]).stem}_cam.txt")
    masks, mask_notes = find_masks(folder, images if masked else {})
    frames = [_mvs_frame(cameras[name], images[image], masks.get(image)) for name, image in pairs.items()]
    notes = (*mask_notes, *unpaired_note("image", [name for name in cameras if name not in pairs]))
    return Layout("BlendedMVS", tuple(frames), None, notes, example_image=next(iter(cameras), ""))


def _mvs_frame(file: Path, image: Path, mask: Path | None) -> Frame:
    words = file.read_text().split()
    if len(words) < 29 or words[0] != "extrinsic" or words[17] != "intrinsic":
        raise BadInput(f"{file} must have `extrinsic`, 16 numbers, `intrinsic`, 9 numbers and depths: copy it again")
    extrinsics, intrinsics = (np.array(numbers, dtype=np.float64) for numbers in (words[1:17], words[18:27]))
    world_to_camera = homogeneous_matrix(extrinsics.reshape(4, 4), f"{file}, extrinsic")
    near, step, *rest = map(float, words[27:])
    far = rest[1] if len(rest) > 1 else near + step * (rest[0] if rest else 192)
    return Frame(image, intrinsics.reshape(3, 3), world_to_camera, mask, depth_range=(near, far))


FORMAT = Format("BlendedMVS", 60, ("cams/*_cam.txt",), "cams/*_cam.txt (BlendedMVS)", read_layout)
