"""Fig. 24 of DIST: shapes from many views in pictures, from a wrong similarity that is optimised as well."""

from bench.report import gallery
from bench.report.data.experiments import Experiment
from bench.report.data.records import Record, grouped, row_of
from bench.report.gallery import FOUND, START, TRUE, Block, Scene
from bench.report.pages.views import fig12
from bench.report.write.result import Result
from bench.report.write.table import to_data

PLACE = 56
READS = fig12.READS
ARRAYS = tuple(kind + part for kind in (START, FOUND, TRUE) for part in ("normals", "hit"))
UNITS = {"shift": "shifted by {:g}", "degrees": "turned by {:g}°", "scale": "{:g} times\nas large"}
NOTES = (
    "The shape is the one with the least number, not a chosen one. Normals are red, green and blue (right, up, towards "
    "the camera) of the mesh that is judged, seen from the first photograph's side. Units of a shift: scene units.",
    "Start: the shape of the random code, misplaced; at “known place” no similarity is optimised.",
    "DIST, Fig. 24, shows photographs of real chairs, and what PMO makes of them; these shapes are synthetic.",
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a block per family: the start over the displacement, and what each row found below it."""
    shown = gallery.first_shapes(experiment, 1)
    scenes = {name: Scene(shown, records, ARRAYS) for name, records in shown.families().items()}
    blocks = [_block(name, records, scenes[name]) for name, records in shown.families().items()]
    return Result(
        shown,
        "Shapes from many views, misplaced at the start, in pictures.",
        "The first shape of each family: where it began, and what each row found, over the displacement.",
        remarks=(*NOTES, *gallery.missing(scenes.values())),
        data=to_data(fig12.RUNS, shown.records),
        figure=gallery.draw(blocks),
    )


def _block(name: str, records: list[Record], scene: Scene) -> Block:
    of_place = dict(sorted(grouped(records, _place).items()))
    starts = [scene.shared(of, gallery.normals(START)) for of in of_place.values()]
    rows = {"start": [*starts, scene.shared(records, gallery.normals(TRUE))]}
    for row, of_row in grouped(records, row_of).items():
        at = {_place(record): record for record in of_row}
        rows[row.name] = [scene.cell(at.get(place), gallery.normals(FOUND)) for place in of_place]
    return Block(name, [*map(_words, of_place), "truth"], rows)


def _place(record: Record) -> tuple[float, ...]:
    """How far off a run's start is, in each condition, and whether its place is known."""
    return (*(one.of(record) - one.neutral for one in fig12.CONDITIONS), fig12.place_known(record))


def _words(place: tuple[float, ...]) -> str:
    *offs, known = place
    found = [UNITS[one.key].format(off + one.neutral) for one, off in zip(fig12.CONDITIONS, offs, strict=True) if off]
    return "\n".join(found) or ("known\nplace" if known else "in place")
