"""Repairs triangle meshes: makes them closed solids, and notes every change.

PyMeshLab does it. If it is not installed, Open3D closes holes and manifold3d merges parts; a wrap is refused.
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

WRAPPED = "wrapped"  # first word of the note on a mesh that was replaced by a closed surface around it
# Distances without a unit in their name are fractions of the bounding box's diagonal.
MERGE_DISTANCE = 1e-6  # closer vertices are merged: about ten float32 steps
MIN_THICKNESS = 2e-6  # a closed part of less mean thickness encloses nothing
WRAP_ALPHAS = (8.0, 4.0, 2.0, 1.0)  # % of the diagonal: gaps up to this width are closed by a wrap; coarse to fine
WRAP_OFFSET = 0.1  # % of the diagonal: how far outside the surface a wrap lies
MAX_WRAP_LOSS_FRACTION = 0.15  # a finer wrap that loses more volume than this and the next has entered the inside
MAX_WRAP_LOSS = 0.005  # cubed diagonals; a wrap around a sheet loses less
OUTSIDE_DISTANCE = 0.005  # surface farther outside the repaired solid was cut away
WARNING_CHANGE_FRACTION = 0.25  # closing a box that lacks one of six sides adds 20 % of area and 23 % of volume
MIN_WRAP_THICKNESS = 0.003  # a thinner wrap encloses a sheet: it is two offsets thick
NOT_CHECKED_NOTE = "without PyMeshLab, faces of a part that cut through others were not looked for"
MAX_HOLE_SIZE = 10.0  # every hole is narrower
MAX_OUTSIDE_FRACTION = 0.01  # largest fraction of the area that may be cut away


def repair(mesh: Mesh, close: Callable[[Mesh], Mesh | None] | None = None) -> Mesh:
    """Makes a mesh a closed solid, wound outward and without overlaps, with as little change as possible.

    If its area or volume changes by more than `WARNING_CHANGE_FRACTION`, the first entry of `repairs` is a warning.

    Args:
        close: another way to close a mesh whose holes cannot be closed, tried before it is wrapped.

    Raises:
        ValueError: the mesh encloses no volume.
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
    if solid.repairs != mesh.repairs:
        distances = Truth(solid).signed_distance(sample_surface(mesh, 5000, seed=0).points)
        if (distances > OUTSIDE_DISTANCE * mesh.diagonal).mean() > MAX_OUTSIDE_FRACTION:
            reason = "closing its holes and merging its parts would cut away some of its surface"
            return _warned(mesh, _wrap(mesh, reason))
    return _warned(mesh, solid, closed)


def _tidy(mesh: Mesh) -> Mesh:
    """Merges vertices at the same place, drops faces without three corners and duplicate faces.

    Two faces back to back cancel, unless their whole part is double-sided: then one side is kept.
    """
    mesh = mesh.compact()
    # An absolute value, since this filter takes percentages of a hundredth of the diagonal.
    options = {"threshold": lab.PureValue(MERGE_DISTANCE * mesh.diagonal)} if (lab := meshlab()) else {}
    mesh = apply(mesh, ("meshing_merge_close_vertices", options))
    faces = mesh.faces
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    rolled = np.take_along_axis(faces, (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    side = np.where(rolled[:, 1] < rolled[:, 2], 1, -1)
    _, first, face_ids = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True)
    net = np.bincount(face_ids.ravel(), weights=side).astype(int)
    keep = first[net != 0]
    parts = replace(mesh, faces=faces).parts
    double_sided = first[~np.isin(parts[first], parts[keep])]
    kept = np.sort(np.concatenate([keep, double_sided]))
    tidy = replace(mesh, faces=faces[kept])
    copies, copied_faces = _copies(replace(mesh, faces=faces[first]), np.abs(net) - 1)
    if copies:
        tidy = with_note(tidy, f"{_count(copies, 'part')} with the same faces as another dropped")
    doubled = len(faces) - len(kept) - copied_faces
    return with_note(tidy, f"{_count(doubled, 'doubled face')} dropped") if doubled else tidy


def _copies(mesh: Mesh, counts: Int[np.ndarray, " f"]) -> tuple[int, int]:
    """The number of duplicate closed parts, and of their faces. `counts` is how often each face is repeated."""
    if not (counts > 0).any():
        return 0, 0
    repeated, counts = replace(mesh, faces=mesh.faces[counts > 0]), counts[counts > 0]
    closed = np.setdiff1d(repeated.parts, repeated.parts[repeated.open_faces])
    by_part = [counts[repeated.parts == label] for label in closed]  # a part is repeated as often as its rarest face
    return int(sum(faces.min() for faces in by_part)), int(sum(faces.min() * len(faces) for faces in by_part))


def _close(mesh: Mesh) -> Mesh:
    """Closes open parts: orients their faces consistently; if that is not enough, fills their holes."""
    parts = mesh.parts
    is_open = np.isin(parts, parts[mesh.open_faces])
    if not is_open.any():
        return mesh
    shells = replace(mesh, faces=mesh.faces[is_open])
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
        if (count := count_holes(shells) - count_holes(closed)) > 0:
            closed = with_note(closed, f"{_count(count, 'hole')} closed")
    faces = np.concatenate([mesh.faces[~is_open], closed.faces + len(mesh.vertices)])
    return replace(closed, vertices=np.concatenate([mesh.vertices, closed.vertices]), faces=faces).compact()


def count_holes(mesh: Mesh) -> int:
    """Number of loops of edges that have a face on one side only."""
    import trimesh

    directed = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, uses = np.unique(directed, axis=0, return_counts=True)
    rim = edges[uses == 1]
    labels = trimesh.graph.connected_component_labels(rim, node_count=len(mesh.vertices))
    return len(np.unique(labels[rim]))


def _drop_flat_parts(mesh: Mesh) -> Mesh | None:
    """Drops the parts that enclose nothing; None if no part is left."""
    parts = mesh.parts
    areas = np.bincount(parts, weights=np.linalg.norm(mesh.area_normals, axis=1) / 2)
    is_flat = 2 * np.abs(mesh.part_volumes) <= MIN_THICKNESS * mesh.diagonal * areas
    if is_flat.all() or not is_flat.any():
        return None if is_flat.all() else mesh
    kept = replace(mesh, faces=mesh.faces[~is_flat[parts]])
    return with_note(kept.compact(), f"{_count(int(is_flat.sum()), 'part')} without thickness dropped")


def _turn_outward(mesh: Mesh) -> Mesh:
    """Turns parts that are inside out, except cavities: inverted parts that lie within another."""
    parts = mesh.parts
    volumes = mesh.part_volumes
    sign = 1 if volumes.sum() > 0 else -1  # the whole mesh, with its cavities, may be inside out
    outward = sign * volumes > 0
    for label in np.flatnonzero(~outward):
        points = mesh.vertices[mesh.faces[parts == label, 0]][:16]
        outer_faces = mesh.faces[outward[parts]]
        outward[label] = bool((sign * _winding(points, mesh.vertices, outer_faces) > 0.5).all())
    turn = ~outward if sign > 0 else outward
    if not turn.any():
        return mesh
    faces = np.where(turn[parts][:, None], mesh.faces[:, ::-1], mesh.faces)
    return with_note(replace(mesh, faces=faces), f"{_count(int(turn.sum()), 'part')} turned outward")


def _merge(mesh: Mesh) -> Mesh | None:
    """Merges overlapping parts, so that surfaces inside the solid vanish; None if that fails."""
    lab = meshlab()
    if lab is None:
        return with_note(_united(mesh), NOT_CHECKED_NOTE)
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
    remaining = merged.parts.max() + 1
    if remaining < count:
        return with_note(merged, f"{count} overlapping parts merged into {remaining}")
    return with_note(merged, f"{_count(crossing, 'face')} that cut through others merged") if crossing else mesh


def _united(mesh: Mesh) -> Mesh:
    """Merges overlapping parts with manifold3d; parts that do not overlap stay as they are.

    Raises:
        BadInput: manifold3d is not installed, or cannot merge the parts.
    """
    import trimesh

    pieces = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).split(only_watertight=False)
    touching = mesh.parts.max() == 0 and not all(piece.is_watertight for piece in pieces)  # along edges of four faces
    if len(pieces) == 1 or touching:
        return mesh
    solids = [piece for piece in pieces if piece.volume > 0]  # others are cavities
    try:
        union = trimesh.boolean.union(solids, engine="manifold")
    except (ImportError, ValueError) as error:
        raise BadInput("its parts may overlap, to merge them: pip install manifold3d, or pymeshlab (GPL-3)") from error
    if union.volume > (1 - MERGE_DISTANCE) * sum(piece.volume for piece in solids):
        return mesh
    if len(solids) < len(pieces):
        require_meshlab("a mesh with cavities and overlapping parts")
    merged = replace(mesh, vertices=union.vertices, faces=union.faces)
    return with_note(merged, f"{len(solids)} overlapping parts merged into {merged.parts.max() + 1}")


def _wrap(mesh: Mesh, reason: str) -> Mesh:
    """Shrinks a closed surface around the mesh, as fine as possible without entering its inside."""
    lab = require_meshlab(f"the mesh must be wrapped, since {reason}, which")
    wrapped = None
    for alpha in WRAP_ALPHAS:
        meshes = mesh_set(mesh)
        percentages = {"alpha": lab.PercentageValue(alpha), "offset": lab.PercentageValue(WRAP_OFFSET)}
        meshes.generate_alpha_wrap(**percentages)
        finer = current(meshes, mesh)
        if wrapped is not None:
            lost = wrapped.volume - finer.volume
            if lost > MAX_WRAP_LOSS_FRACTION * wrapped.volume and lost > MAX_WRAP_LOSS * mesh.diagonal**3:
                break
        wrapped, gap = finer, alpha
    how = f"a closed surface shrunk around it, {WRAP_OFFSET:g} % of the diagonal outside, over gaps up to {gap:g} %"
    return with_note(wrapped, f"{WRAPPED}: {how}, since {reason}")


def _wrap_flat(mesh: Mesh) -> Mesh:
    """Wraps a mesh whose parts are all flat: walls around a room enclose a volume, sheets do not.

    Raises:
        ValueError: the wrap is as thin as one around a sheet.
    """
    wrapped = _wrap(mesh, "all its parts are flat")
    if 2 * wrapped.volume > MIN_WRAP_THICKNESS * mesh.diagonal * wrapped.area:
        return wrapped
    faces = "a single triangle" if len(mesh.faces) == 1 else f"{_count(len(mesh.faces), 'face')} in flat sheets"
    repairs = f" (after {'; '.join(mesh.repairs)})" if mesh.repairs else ""
    raise ValueError(
        f"must enclose a volume, found {faces}{repairs}; copy the file again if it is truncated, else export a closed "
        "surface or give the sheet a thickness"
    )


def _warned(original: Mesh, repaired: Mesh, closed: Mesh | None = None) -> Mesh:
    """The repaired mesh, with a warning if its area or volume changed much.

    Args:
        closed: the mesh before overlapping parts were merged. It counts overlaps twice, so the smaller change counts.
    """
    if repaired.repairs == original.repairs:
        return repaired
    consistent = apply(original, ("meshing_re_orient_faces_coherently", {}))
    changes = []
    for name, old, *new in (
        ("area", original.area, repaired.area, *([closed.area] if closed else [])),
        ("volume", _enclosed(consistent), repaired.volume, *([_enclosed(closed)] if closed else [])),
    ):
        if old > 0 and min(abs(value - old) for value in new) > WARNING_CHANGE_FRACTION * old:
            changes.append(f"{name} from {old:.4g} to {new[0]:.4g} ({new[0] / old - 1:+.0%})")
    if not changes:
        return repaired
    change = " and ".join(changes)
    warning = f"warning: repair changed the {change}, in the file's units: check the pictures, or repair the file"
    return replace(repaired, repairs=(warning, *repaired.repairs))


def _enclosed(mesh: Mesh) -> float:
    """The volume of all parts; for an open part, the volume between its faces and their centroid."""
    parts = mesh.parts
    faces = np.bincount(parts)
    corners = mesh.vertices[mesh.faces]
    middles = np.stack([np.bincount(parts, weights=axis) / faces for axis in corners.mean(axis=1).T], axis=1)
    heights = ((corners[:, 0] - middles[parts]) * mesh.area_normals).sum(axis=1)
    return float(np.abs(np.bincount(parts, weights=heights / 6)).sum())


def _winding(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Winding numbers of faces around points: the solid angle in turns (van Oosterom and Strackee 1983)."""
    a, b, c = np.moveaxis(vertices[faces][None] - points[:, None, None], 2, 0)
    x, y, z = (np.linalg.norm(corner, axis=-1) for corner in (a, b, c))
    top = (a * np.cross(b, c)).sum(-1)
    bottom = x * y * z + (a * b).sum(-1) * z + (b * c).sum(-1) * x + (c * a).sum(-1) * y
    return np.arctan2(top, bottom).sum(axis=1) / (2 * np.pi)


def meshlab() -> ModuleType | None:
    """PyMeshLab; None if it is not installed, for example because its licence, GPL-3, is not wanted."""
    try:
        import pymeshlab
    except ImportError:
        return None
    return pymeshlab


def require_meshlab(operation: str) -> ModuleType:
    """PyMeshLab; raises BadInput if it is not installed."""
    if (lab := meshlab()) is None:
        raise BadInput(f"{operation} needs PyMeshLab (GPL-3), which is not installed: pip install pymeshlab")
    return lab


def mesh_set(mesh: Mesh):
    """The mesh for filters of PyMeshLab, which must be installed."""
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(mesh.vertices, mesh.faces.astype(np.int32)))
    return meshes


def current(meshes, original: Mesh) -> Mesh:
    """The current mesh of a mesh set, with the notes of the original."""
    filtered = meshes.current_mesh()
    return replace(original, vertices=filtered.vertex_matrix(), faces=filtered.face_matrix())


def apply(mesh: Mesh, *filters: tuple[str, dict]) -> Mesh:
    """Runs filters of PyMeshLab. A filter that fails leaves the mesh unchanged; the caller checks the outcome."""
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
    """Applies Open3D's version of a PyMeshLab filter; returns the mesh unchanged if Open3D has none."""
    import open3d

    vectors = open3d.utility.Vector3dVector(mesh.vertices), open3d.utility.Vector3iVector(mesh.faces)
    converted = open3d.geometry.TriangleMesh(*vectors)
    if name == "meshing_merge_close_vertices":
        converted.merge_close_vertices(MERGE_DISTANCE * mesh.diagonal)
    elif name == "meshing_re_orient_faces_coherently":
        converted.orient_triangles()
    elif name == "meshing_repair_non_manifold_edges":
        converted.remove_non_manifold_edges()
    elif name == "meshing_close_holes":
        tensor_mesh = open3d.t.geometry.TriangleMesh.from_legacy(converted, vertex_dtype=open3d.core.float64)
        converted = tensor_mesh.fill_holes(MAX_HOLE_SIZE * mesh.diagonal).to_legacy()
    return replace(mesh, vertices=np.array(converted.vertices), faces=np.array(converted.triangles))


def with_note(mesh: Mesh, repair: str) -> Mesh:
    return replace(mesh, repairs=(*mesh.repairs, repair))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
