"""Figs. 8 and 19 of DIST: shapes and colours from codes, rendered at several sizes, from several sides and lights."""

import numpy as np

from bench.report.study import Result, Runs, Selection, format, gallery, records, table

PLACE = 47
READS = (Selection("fig8", conditions=("split",), setup=("machine",)),)
SIDES = {  # prefixes in images.npz, see `bench.pictures.colours.picture_arrays`; turns are about the vertical axis
    "coarse": "size_0_",
    "finer": "size_1_",
    "full size": "size_2_",
    "turned by 120°": "turned_0_",
    "turned by 240°": "turned_1_",
}
LIGHTS = {  # directions to the light; axes to the right, up, towards the camera
    "light from the left": (-0.8, 0.3, 0.5),
    "light from above": (0.0, 0.9, 0.45),
    "light from the right": (0.8, 0.3, 0.5),
}
AMBIENT = 0.25  # ambient fraction of a light; the rest is proportional to the cosine
KINDS = {"true_": "mesh", "trained_": "code of training", "": "code of the image"}
SIZES = ("code_bytes", "mesh_bytes", "texture_bytes", "network_bytes")
DEFINED = {key: f"{key.partition('_')[0].capitalize()} (bytes)" for key in SIZES} | {"colour_error": "Error of colour"}


def _name(record: records.Record) -> str:
    return f"{records.family(record)}, {records.setting(record['config'], 'split')} {records.index(record)}"


COLUMNS = (
    table.text("shape", "Shape", _name),
    *(table.metric(key, DEFINED[key], table.integer) for key in SIZES),
    table.metric("colour_error", DEFINED["colour_error"]),
    table.metric("chamfer_l2", "Chamfer-L2 × 1000", table.thousandfold),
)


def make(runs: Runs) -> Result:
    code, *mesh_and_texture, network = (runs.number(key).median() for key in SIZES)
    errors = runs.number("colour_error").groupby(runs.setting("split"), sort=False).median()
    texts = ", ".join(f"*{error:.2g}* ({split})" for split, error in errors.items())
    scenes = {_name(record): gallery.Scene(runs, [record], _arrays(record)) for record in runs.records}
    return Result(
        runs,
        "Shapes and colours of latent codes, rendered at several sizes, from several sides and lights.",
        "Renderings of the mesh and of its latent codes of shape and colour; a test shape has no code of training.",
        question="How accurate are the colours of a latent code, and how large is the code?",
        verdict=f"Median error of colour (0 to 1): {texts}; n = {format.plural(len(runs.records), 'shape')}. "
        f"A code has {code:.0f} bytes, the network of all codes of a family {network / 1000:.0f} kB, the original mesh "
        f"and texture {sum(mesh_and_texture) / 1000:.0f} kB (medians).",
        remarks=(
            "Meshes have their original triangles. A mesh with the same error as its code has far fewer.",
            "A “code of the image” is optimised from the colours and the mask of the given image, without depth.",
            f"Lights: colours times {AMBIENT:g} + {1 - AMBIENT:g} max(normal · light, 0), without shadows.",
            *records.definitions(runs.records, DEFINED),
            *gallery.missing_notes(scenes.values()),
        ),
        columns=COLUMNS,
        lines=runs.records,
        run_columns=(table.FAMILY, *table.IDENTITY, *COLUMNS[1:]),
        figure=gallery.draw([_block(scenes[_name(record)], record) for record in runs.records]),
    )


def _kinds(record: records.Record) -> dict[str, str]:
    trained = records.setting(record["config"], "split") == "train"
    return {prefix: kind for prefix, kind in KINDS.items() if trained or prefix != "trained_"}


def _arrays(record: records.Record) -> list[str]:
    sides = [kind + side for kind in _kinds(record) for side in SIDES.values()]
    return ["photograph", *(side + array for side in sides for array in ("colours", "normals", "hit"))]


def _block(scene: gallery.Scene, record: records.Record) -> gallery.Block:
    first, rows = {"": scene.full_picture([record], "photograph")}, {}
    for prefix, kind in _kinds(record).items():
        paints = [gallery.colours(prefix + side) for side in SIDES.values()]
        paints += [_lit(prefix + SIDES["full size"], light) for light in LIGHTS.values()]
        rows[kind] = [first.get(prefix, gallery.Cell()), *(scene.cell(record, paint) for paint in paints)]
    return gallery.Block(_name(record), ["given", *SIDES, *LIGHTS], rows)


def _lit(prefix: str, light: tuple[float, float, float]) -> gallery.Paint:
    def paint(arrays: gallery.Arrays) -> list[np.ndarray]:
        colours, normals, hit = (arrays[prefix + name] for name in ("colours", "normals", "hit"))
        cosine = (normals @ light / np.linalg.norm(light)).clip(0)[..., None]
        return [gallery.on_white(colours * (AMBIENT + (1 - AMBIENT) * cosine), hit)]

    return paint


PAGES = {"rerendering": make}
