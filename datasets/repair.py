"""Repair: any triangle mesh becomes a closed solid, and every change is told."""

import contextlib
from dataclasses import replace

import numpy as np

from datasets.mesh import Mesh
from datasets.truth import Truth, sample_surface

WELD = 1e-6  # of the diagonal: vertices nearer than this, about ten float32 steps, are one
THIN = 1e-6  # of the diagonal: a closed part thinner than this on average encloses nothing
WRAP_ALPHAS = (8.0, 4.0, 2.0, 1.0)  # % of the diagonal: widest gap that a wrap does not enter, coarse to fine
WRAP_OFFSET = 0.1  # % of the diagonal: how far outside the surface a wrap lies
HOLLOW_SHARE = 0.15  # of the coarser wrap's volume: a finer one that loses more has entered the inside,
HOLLOW_SIZE = 0.005  # but for less than this share of the diagonal cubed, as around a sheet
OUTSIDE_BY = 0.005  # of the diagonal: surface farther outside the repaired solid than this was cut away
OUTSIDE_SHARE = 0.01  # of the area: more cut away than this is not accepted


def repair(mesh: Mesh) -> Mesh:
    """Makes a mesh a closed solid, wound outward and without overlaps, with as little change as does it."""
    mesh = _tidy(mesh)
    closed = _drop_flat_parts(_close(mesh))
    if closed is None:
        return _wrap(mesh, "it is a sheet that encloses nothing")
    if not closed.watertight:
        return _wrap(closed, "its parts do not close into a solid")
    solid = _merge(_turn_outward(closed))
    if solid is None:
        return _wrap(closed, "its overlapping parts could not be merged into a solid")
    if solid.repairs != mesh.repairs and not _covers(solid, mesh):
        return _wrap(mesh, "closing its holes and merging its parts would cut away some of its surface")
    return solid


def _tidy(mesh: Mesh) -> Mesh:
    """Makes vertices at the same place one, drops faces without three corners and faces that are given twice.

    Two faces back to back cancel, unless their whole part is double-sided: of such a part one side stays.
    """
    import pymeshlab

    mesh = mesh.compact()
    mesh = _apply(mesh, ("meshing_merge_close_vertices", {"threshold": pymeshlab.PercentageValue(100 * WELD)}))
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
    if len(kept) == len(faces):
        return replace(mesh, faces=faces)
    return _told(replace(mesh, faces=faces[kept]), f"{_count(len(faces) - len(kept), 'doubled face')} dropped")


def _close(mesh: Mesh) -> Mesh:
    """Closes the parts that are open, by winding them consistently or else by closing their holes."""
    parts = mesh.parts
    opened = np.isin(parts, parts[mesh.open_faces])
    if not opened.any():
        return mesh
    shells = replace(mesh, faces=mesh.faces[opened])
    wind = ("meshing_re_orient_faces_coherently", {})
    closed = _apply(shells, wind)
    if closed.watertight:
        closed = _told(closed, "faces wound consistently")
    else:
        cut = ("meshing_repair_non_manifold_edges", {"method": "Remove Faces"})
        split = ("meshing_repair_non_manifold_vertices", {"vertdispratio": 0.0})
        fill = ("meshing_close_holes", {"maxholesize": len(mesh.vertices), "selfintersection": False})
        shells = _apply(shells, cut, split, wind)
        closed = _apply(shells, fill, wind)
        if (count := shells.holes - closed.holes) > 0:
            closed = _told(closed, f"{_count(count, 'hole')} closed")
    faces = np.concatenate([mesh.faces[~opened], closed.faces + len(mesh.vertices)])
    return replace(closed, vertices=np.concatenate([mesh.vertices, closed.vertices]), faces=faces).compact()


def _drop_flat_parts(mesh: Mesh) -> Mesh | None:
    """Drops the parts that enclose nothing; None if no part is left."""
    parts = mesh.parts
    areas = np.bincount(parts, weights=np.linalg.norm(mesh.crosses, axis=1) / 2)
    flat = np.abs(mesh.part_volumes) <= THIN * mesh.diagonal * areas
    if flat.all():
        return None
    if not flat.any():
        return mesh
    kept = replace(mesh, faces=mesh.faces[~flat[parts]])
    return _told(kept.compact(), f"{_count(int(flat.sum()), 'part')} without thickness dropped")


def _turn_outward(mesh: Mesh) -> Mesh:
    """Turns the parts that are inside out, but for cavities: inverted parts that lie within another."""
    parts = mesh.parts
    volumes = mesh.part_volumes
    sign = 1 if volumes.sum() > 0 else -1  # the whole mesh may be inside out, its cavities with it
    outward = sign * volumes > 0
    for part in np.flatnonzero(~outward):
        points = mesh.vertices[mesh.faces[parts == part, 0]][:16]
        around = mesh.faces[outward[parts]]
        outward[part] = bool((sign * _winding(points, mesh.vertices, around) > 0.5).all())
    turn = ~outward if sign > 0 else outward
    if not turn.any():
        return mesh
    faces = np.where(turn[parts][:, None], mesh.faces[:, ::-1], mesh.faces)
    return _told(replace(mesh, faces=faces), f"{_count(int(turn.sum()), 'part')} turned outward")


def _merge(mesh: Mesh) -> Mesh | None:
    """Merges what overlaps, so that a ray crosses the surface once between in and out; None if it cannot."""
    import pymeshlab

    count = mesh.parts.max() + 1
    meshes = _mesh_set(mesh)
    meshes.compute_selection_by_self_intersections_per_face()
    crossing = meshes.current_mesh().selected_face_number()
    if count == 1 and not crossing:
        return mesh
    try:
        meshes.generate_boolean_union(first_mesh=0, second_mesh=0)
    except pymeshlab.PyMeshLabException:
        return None
    if meshes.current_mesh().face_number() == 0:
        return None
    merged = _current(meshes, mesh)
    if not (merged.watertight and merged.volume > 0):
        return None
    left = merged.parts.max() + 1
    if left < count:
        return _told(merged, f"{count} overlapping parts merged into {left}")
    return _told(merged, f"{_count(crossing, 'face')} that cut through others merged") if crossing else mesh


def _covers(solid: Mesh, mesh: Mesh) -> bool:
    """True if next to nothing of the mesh's surface lies outside the solid."""
    points, _ = sample_surface(mesh, 5000, seed=0)
    outside = Truth(solid).signed_distance(points) > OUTSIDE_BY * mesh.diagonal
    return bool(outside.mean() <= OUTSIDE_SHARE)


def _wrap(mesh: Mesh, reason: str) -> Mesh:
    """Shrinks a closed surface around the mesh, as finely as goes without entering its inside."""
    import pymeshlab

    wrapped = None
    for alpha in WRAP_ALPHAS:
        meshes = _mesh_set(mesh)
        percentages = {"alpha": pymeshlab.PercentageValue(alpha), "offset": pymeshlab.PercentageValue(WRAP_OFFSET)}
        meshes.generate_alpha_wrap(**percentages)
        finer = _current(meshes, mesh)
        if wrapped is not None:
            lost = wrapped.volume - finer.volume
            if lost > HOLLOW_SHARE * wrapped.volume and lost > HOLLOW_SIZE * mesh.diagonal**3:
                break
        wrapped, used = finer, alpha
    how = f"a closed surface shrunk around it, {WRAP_OFFSET:g} % of the diagonal outside, over gaps up to {used:g} %"
    return _told(wrapped, f"wrapped: {how}, since {reason}")


def _winding(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Winding numbers of faces around points: the solid angle in turns (van Oosterom and Strackee 1983)."""
    a, b, c = np.moveaxis(vertices[faces][None] - points[:, None, None], 2, 0)
    x, y, z = (np.linalg.norm(corner, axis=-1) for corner in (a, b, c))
    top = (a * np.cross(b, c)).sum(-1)
    bottom = x * y * z + (a * b).sum(-1) * z + (b * c).sum(-1) * x + (c * a).sum(-1) * y
    return np.arctan2(top, bottom).sum(axis=1) / (2 * np.pi)


def _mesh_set(mesh: Mesh):
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(mesh.vertices, mesh.faces.astype(np.int32)))
    return meshes


def _current(meshes, before: Mesh) -> Mesh:
    current = meshes.current_mesh()
    return replace(before, vertices=current.vertex_matrix(), faces=current.face_matrix())


def _apply(mesh: Mesh, *filters: tuple[str, dict]) -> Mesh:
    """Runs filters of pymeshlab; one that refuses leaves the mesh as it is, and the caller's checks decide."""
    import pymeshlab

    meshes = _mesh_set(mesh)
    for name, options in filters:
        with contextlib.suppress(pymeshlab.PyMeshLabException):
            meshes.apply_filter(name, **options)
    return _current(meshes, mesh)


def _told(mesh: Mesh, repair: str) -> Mesh:
    return replace(mesh, repairs=(*mesh.repairs, repair))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
