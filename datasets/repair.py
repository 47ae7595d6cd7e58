"""Repairs triangle meshes: makes them closed solids, and notes every change.

PyMeshLab does it. Where it is not installed, Open3D closes holes and manifold3d merges parts; a wrap is refused.
"""

import contextlib
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType

import numpy as np
from jaxtyping import Int

from datasets.mesh import Mesh
from datasets.scene import Truth, sample_surface
from renderers.checks import BadInput

WRAPPED = "wrapped"  # begins the note of a mesh whose inside is what a closed surface around it encloses
WELD = 1e-6  # of the diagonal: vertices closer than this, about ten float32 steps, are merged
THIN = 2e-6  # of the diagonal: a closed part of less mean thickness encloses nothing
WRAP_ALPHAS = (8.0, 4.0, 2.0, 1.0)  # % of the diagonal: gaps up to this width are closed by a wrap; coarse to fine
WRAP_OFFSET = 0.1  # % of the diagonal: how far outside the surface a wrap lies
HOLLOW_SHARE = 0.15  # of the coarser wrap's volume: a finer wrap that loses more has entered the inside,
HOLLOW_SIZE = 0.005  # unless it loses less than this share of the cubed diagonal, as around a sheet
OUTSIDE_BY = 0.005  # of the diagonal: surface farther outside the repaired solid than this was cut away
CHANGED = 0.25  # of area or volume: more gives a warning. Closing a box that lacks one of six sides adds 20 and 23 %
SHEET = 0.003  # of the diagonal: a wrap of less mean thickness is that of a sheet, two offsets thick
UNSEEN = "without PyMeshLab, faces of a part that cut through others were not looked for"
WIDEST = 10.0  # diagonals: every hole is narrower
OUTSIDE_SHARE = 0.01  # of the area: more cut away than this is not accepted


def repair(mesh: Mesh, close: Callable[[Mesh], Mesh | None] | None = None) -> Mesh:
    """Makes a mesh a closed solid, wound outward and without overlaps, with as little change as possible.

    Where that changes its area or volume by more than `CHANGED`, the first entry of `repairs` is a warning.

    Args:
        close: another way to close a mesh whose holes cannot be closed, tried before it is wrapped.

    Raises:
        ValueError: where it encloses no volume.
    """
    mesh = _tidy(mesh)
    closed = _drop_flat_parts(_close(mesh))
    if closed is None:
        return _warned(mesh, _wrap_flat(mesh))
    if not closed.watertight:
        solid = close(mesh) if close else None
        return _warned(mesh, solid or _wrap(closed, "its parts do not close into a solid"))
    solid = _merge(_turn_outward(closed))
    if solid is None:
        return _warned(mesh, _wrap(closed, "its overlapping parts could not be merged into a solid"))
    if solid.repairs != mesh.repairs and not _covers(solid, mesh):
        return _warned(mesh, _wrap(mesh, "closing its holes and merging its parts would cut away some of its surface"))
    return _warned(mesh, solid, closed)


def _tidy(mesh: Mesh) -> Mesh:
    """Merges vertices at the same place, drops faces without three corners and duplicate faces.

    Two faces back to back cancel, unless their whole part is double-sided: then one side is kept.
    """
    mesh = mesh.compact()
    # A percentage would be one of a hundredth of the diagonal: that is the largest threshold of this filter.
    weld = {"threshold": lab.PureValue(WELD * mesh.diagonal)} if (lab := meshlab()) else {}
    mesh = apply(mesh, ("meshing_merge_close_vertices", weld))
    faces = mesh.faces
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    rolled = np.take_along_axis(faces, (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    side = np.where(rolled[:, 1] < rolled[:, 2], 1, -1)
    _, first, same = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True)
    net = np.bincount(same.ravel(), weights=side).astype(int)
    keep = first[net != 0]
    parts = replace(mesh, faces=faces).parts
    double_sided = first[~np.isin(parts[first], parts[keep])]
    kept = np.sort(np.concatenate([keep, double_sided]))
    tidy = replace(mesh, faces=faces[kept])
    copies, of_copies = _copies(replace(mesh, faces=faces[first]), np.abs(net) - 1)
    if copies:
        tidy = with_note(tidy, f"{_count(copies, 'part')} with the same faces as another dropped")
    left = len(faces) - len(kept) - of_copies
    return with_note(tidy, f"{_count(left, 'doubled face')} dropped") if left else tidy


def _copies(mesh: Mesh, again: Int[np.ndarray, " f"]) -> tuple[int, int]:
    """How many closed parts are there once more, and the faces of these; `again` is how often each face is."""
    if not (again > 0).any():
        return 0, 0
    twice, again = replace(mesh, faces=mesh.faces[again > 0]), again[again > 0]
    closed = np.setdiff1d(twice.parts, twice.parts[twice.open_faces])
    members = [again[twice.parts == part] for part in closed]  # a part is there as often as its rarest face
    return int(sum(part.min() for part in members)), int(sum(part.min() * len(part) for part in members))


def _close(mesh: Mesh) -> Mesh:
    """Closes open parts, by winding them consistently or else by closing their holes."""
    parts = mesh.parts
    opened = np.isin(parts, parts[mesh.open_faces])
    if not opened.any():
        return mesh
    shells = replace(mesh, faces=mesh.faces[opened])
    wind = ("meshing_re_orient_faces_coherently", {})
    closed = apply(shells, wind)
    if closed.watertight:
        closed = with_note(closed, "faces wound consistently")
    else:
        cut = ("meshing_repair_non_manifold_edges", {"method": "Remove Faces"})
        split = ("meshing_repair_non_manifold_vertices", {"vertdispratio": 0.0})
        fill = ("meshing_close_holes", {"maxholesize": len(mesh.vertices), "selfintersection": False})
        shells = apply(shells, cut, split, wind)
        closed = apply(shells, fill, wind)
        if (count := shells.holes - closed.holes) > 0:
            closed = with_note(closed, f"{_count(count, 'hole')} closed")
    faces = np.concatenate([mesh.faces[~opened], closed.faces + len(mesh.vertices)])
    return replace(closed, vertices=np.concatenate([mesh.vertices, closed.vertices]), faces=faces).compact()


def _drop_flat_parts(mesh: Mesh) -> Mesh | None:
    """Drops the parts that enclose nothing; None if no part is left."""
    parts = mesh.parts
    areas = np.bincount(parts, weights=np.linalg.norm(mesh.crosses, axis=1) / 2)
    flat = 2 * np.abs(mesh.part_volumes) <= THIN * mesh.diagonal * areas
    if flat.all() or not flat.any():
        return None if flat.all() else mesh
    kept = replace(mesh, faces=mesh.faces[~flat[parts]])
    return with_note(kept.compact(), f"{_count(int(flat.sum()), 'part')} without thickness dropped")


def _turn_outward(mesh: Mesh) -> Mesh:
    """Turns parts that are inside out, except cavities: inverted parts that lie within another."""
    parts = mesh.parts
    volumes = mesh.part_volumes
    sign = 1 if volumes.sum() > 0 else -1  # the whole mesh, with its cavities, may be inside out
    outward = sign * volumes > 0
    for part in np.flatnonzero(~outward):
        points = mesh.vertices[mesh.faces[parts == part, 0]][:16]
        around = mesh.faces[outward[parts]]
        outward[part] = bool((sign * _winding(points, mesh.vertices, around) > 0.5).all())
    turn = ~outward if sign > 0 else outward
    if not turn.any():
        return mesh
    faces = np.where(turn[parts][:, None], mesh.faces[:, ::-1], mesh.faces)
    return with_note(replace(mesh, faces=faces), f"{_count(int(turn.sum()), 'part')} turned outward")


def _merge(mesh: Mesh) -> Mesh | None:
    """Merges overlapping parts, so that surfaces inside the solid vanish; None where that fails."""
    lab = meshlab()
    if lab is None:
        return with_note(_united(mesh), UNSEEN)
    count = mesh.parts.max() + 1
    meshes = mesh_set(mesh)
    meshes.compute_selection_by_self_intersections_per_face()
    crossing = meshes.current_mesh().selected_face_number()
    if count == 1 and not crossing:
        return mesh
    try:
        meshes.generate_boolean_union(first_mesh=0, second_mesh=0)
    except lab.PyMeshLabException:
        return None
    if meshes.current_mesh().face_number() == 0:
        return None
    merged = current(meshes, mesh)
    if not (merged.watertight and merged.volume > 0):
        return None
    left = merged.parts.max() + 1
    if left < count:
        return with_note(merged, f"{count} overlapping parts merged into {left}")
    return with_note(merged, f"{_count(crossing, 'face')} that cut through others merged") if crossing else mesh


def _united(mesh: Mesh) -> Mesh:
    """What `_merge` does, by manifold3d; parts that do not overlap stay as they are.

    Raises:
        BadInput: where it is not installed, or cannot merge them.
    """
    import trimesh

    parts = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).split(only_watertight=False)
    touching = mesh.parts.max() == 0 and not all(part.is_watertight for part in parts)  # along edges of four faces
    if len(parts) == 1 or touching:
        return mesh
    whole = [part for part in parts if part.volume > 0]  # others are cavities
    try:
        made = trimesh.boolean.union(whole, engine="manifold")
    except (ImportError, ValueError) as error:
        raise BadInput("its parts may overlap, to merge them: pip install manifold3d, or pymeshlab (GPL-3)") from error
    if made.volume > (1 - WELD) * sum(part.volume for part in whole):
        return mesh
    if len(whole) < len(parts):
        needed_meshlab("a mesh with cavities and overlapping parts")
    merged = replace(mesh, vertices=made.vertices, faces=made.faces)
    return with_note(merged, f"{len(whole)} overlapping parts merged into {merged.parts.max() + 1}")


def _covers(solid: Mesh, mesh: Mesh) -> bool:
    """True where at most `OUTSIDE_SHARE` of the mesh's surface lies outside the solid."""
    points = sample_surface(mesh, 5000, seed=0).points
    outside = Truth(solid).signed_distance(points) > OUTSIDE_BY * mesh.diagonal
    return bool(outside.mean() <= OUTSIDE_SHARE)


def _wrap(mesh: Mesh, reason: str) -> Mesh:
    """Shrinks a closed surface around the mesh, as fine as possible without entering its inside."""
    lab = needed_meshlab(f"the mesh must be wrapped, since {reason}, which")
    wrapped = None
    for alpha in WRAP_ALPHAS:
        meshes = mesh_set(mesh)
        percentages = {"alpha": lab.PercentageValue(alpha), "offset": lab.PercentageValue(WRAP_OFFSET)}
        meshes.generate_alpha_wrap(**percentages)
        finer = current(meshes, mesh)
        if wrapped is not None:
            lost = wrapped.volume - finer.volume
            if lost > HOLLOW_SHARE * wrapped.volume and lost > HOLLOW_SIZE * mesh.diagonal**3:
                break
        wrapped, used = finer, alpha
    how = f"a closed surface shrunk around it, {WRAP_OFFSET:g} % of the diagonal outside, over gaps up to {used:g} %"
    return with_note(wrapped, f"{WRAPPED}: {how}, since {reason}")


def _wrap_flat(mesh: Mesh) -> Mesh:
    """Wraps a mesh whose parts are all flat: walls around a room enclose a volume, sheets do not.

    Raises:
        ValueError: where they have none.
    """
    wrapped = _wrap(mesh, "all its parts are flat")
    if 2 * wrapped.volume > SHEET * mesh.diagonal * wrapped.area:
        return wrapped
    found = "a single triangle" if len(mesh.faces) == 1 else f"{_count(len(mesh.faces), 'face')} in flat sheets"
    done = f" (after {'; '.join(mesh.repairs)})" if mesh.repairs else ""
    raise ValueError(
        f"must enclose a volume, found {found}{done}; copy the file again if it is truncated, else export a closed "
        "surface or give the sheet a thickness"
    )


def _warned(before: Mesh, after: Mesh, closed: Mesh | None = None) -> Mesh:
    """The repaired mesh, with a warning where its area or volume changed much.

    Args:
        closed: the mesh before overlapping parts were merged, which counts overlaps twice: the smaller change counts.
    """
    if after.repairs == before.repairs:
        return after
    wound = apply(before, ("meshing_re_orient_faces_coherently", {}))
    changes = []
    for name, was, *now in (
        ("area", before.area, after.area, *([closed.area] if closed else [])),
        ("volume", _enclosed(wound), after.volume, *([_enclosed(closed)] if closed else [])),
    ):
        if was > 0 and min(abs(value - was) for value in now) > CHANGED * was:
            changes.append(f"{name} from {was:.4g} to {now[0]:.4g} ({now[0] / was - 1:+.0%})")
    if not changes:
        return after
    what = " and ".join(changes)
    warning = f"warning: repair changed the {what}, in the file's units: check the pictures, or repair the file"
    return replace(after, repairs=(warning, *after.repairs))


def _enclosed(mesh: Mesh) -> float:
    """The volume of all parts; of an open part, that between its faces and their centroid."""
    parts = mesh.parts
    faces = np.bincount(parts)
    corners = mesh.vertices[mesh.faces]
    middles = np.stack([np.bincount(parts, weights=axis) / faces for axis in corners.mean(axis=1).T], axis=1)
    heights = ((corners[:, 0] - middles[parts]) * mesh.crosses).sum(axis=1)
    return float(np.abs(np.bincount(parts, weights=heights / 6)).sum())


def _winding(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Winding numbers of faces around points: the solid angle in turns (van Oosterom and Strackee 1983)."""
    a, b, c = np.moveaxis(vertices[faces][None] - points[:, None, None], 2, 0)
    x, y, z = (np.linalg.norm(corner, axis=-1) for corner in (a, b, c))
    top = (a * np.cross(b, c)).sum(-1)
    bottom = x * y * z + (a * b).sum(-1) * z + (b * c).sum(-1) * x + (c * a).sum(-1) * y
    return np.arctan2(top, bottom).sum(axis=1) / (2 * np.pi)


def meshlab() -> ModuleType | None:
    """PyMeshLab; None where it is not installed, as where its licence, GPL-3, is not wanted."""
    try:
        import pymeshlab
    except ImportError:
        return None
    return pymeshlab


def needed_meshlab(by: str) -> ModuleType:
    """PyMeshLab; raises BadInput where it is not installed."""
    if (found := meshlab()) is None:
        raise BadInput(f"{by} needs PyMeshLab (GPL-3), which is not installed: pip install pymeshlab")
    return found


def mesh_set(mesh: Mesh):
    """The mesh for filters of PyMeshLab, which must be installed."""
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(mesh.vertices, mesh.faces.astype(np.int32)))
    return meshes


def current(meshes, before: Mesh) -> Mesh:
    """What filters made of a mesh, with its notes."""
    current = meshes.current_mesh()
    return replace(before, vertices=current.vertex_matrix(), faces=current.face_matrix())


def apply(mesh: Mesh, *filters: tuple[str, dict]) -> Mesh:
    """Runs filters of pymeshlab; one that fails leaves the mesh unchanged, which the caller checks."""
    lab = meshlab()
    if lab is None:
        for name, _ in filters:
            mesh = _by_open3d(mesh, name)
        return mesh
    meshes = mesh_set(mesh)
    for name, options in filters:
        with contextlib.suppress(lab.PyMeshLabException):
            meshes.apply_filter(name, **options)
    return current(meshes, mesh)


def _by_open3d(mesh: Mesh, name: str) -> Mesh:
    """What a filter of pymeshlab does; the mesh itself where Open3D has no such filter."""
    import open3d

    vectors = open3d.utility.Vector3dVector(mesh.vertices), open3d.utility.Vector3iVector(mesh.faces)
    made = open3d.geometry.TriangleMesh(*vectors)
    if name == "meshing_merge_close_vertices":
        made.merge_close_vertices(WELD * mesh.diagonal)
    elif name == "meshing_re_orient_faces_coherently":
        made.orient_triangles()
    elif name == "meshing_repair_non_manifold_edges":
        made.remove_non_manifold_edges()
    elif name == "meshing_close_holes":
        there = open3d.t.geometry.TriangleMesh.from_legacy(made, vertex_dtype=open3d.core.float64)
        made = there.fill_holes(WIDEST * mesh.diagonal).to_legacy()
    return replace(mesh, vertices=np.array(made.vertices), faces=np.array(made.triangles))


def with_note(mesh: Mesh, repair: str) -> Mesh:
    """The mesh with another note of what was repaired."""
    return replace(mesh, repairs=(*mesh.repairs, repair))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
