"""Claims of papers after 2020, as ratios of two errors or costs of measured runs."""

from bench.report.claims import NO_LARGER, SEEN_ERROR, Claim
from bench.report.study import Result, Runs, Selection, claims

PLACE = 6
RAYS = "view.rays_per_pixel"
EXPERIMENTS = ("outline", "later_claims")
READS = (Selection("outline", (RAYS,), setup=()), Selection("later_claims", setup=(), may_differ=("field",)))


def _outline(paper: str, text: str, row: str, rays: int) -> Claim:
    return Claim(paper, text, None, "outline", row, "outline_idr", "area_error", top_settings={RAYS: rays})


def _photographs(paper: str, text: str, row: str, reference: str, why: str = "not known") -> Claim:
    return Claim(paper, text, None, "later_claims", row, reference, SEEN_ERROR, why=why)


CLAIMS = (
    _outline(
        "IRON, Sec. 3.3", "edge points fit an outline better than IDR's mask loss, with 1 ray per pixel",
        "outline_edge", 1,
    ),
    _outline(
        "Wang et al. 2024", "a relaxed boundary fits an outline better than IDR's mask loss, with 4 rays per pixel",
        "outline_relaxed", 4,
    ),
    _photographs(
        "Objects as Volumes", "a smaller error than NeuS with as many samples", "later_opaque", "later_neus",
        "the suite agrees: on 24 scenes, both cannot be distinguished",
    ),
    _photographs(
        "Objects as Volumes", "a smaller error than VolSDF, which searches for its samples with 96 others",
        "later_opaque", "later_volsdf", "perhaps the search: VolSDF evaluates 3.4 times as many samples",
    ),
    _photographs(
        "Many worlds 2025", "the loss of samples has a smaller error than that of blended colours",
        "later_neus_samples", "later_neus",
    ),
    _photographs(
        "Stochastic preconditioning", "blurred points reduce the error of a hash grid", "later_hash_blur", "later_hash"
    ),
    Claim(
        "HotSpot", "with the heat loss, a march needs fewer evaluations",
        why="needs the evaluations of the march alone: those of a run include the points of the loss",
    ),
    Claim(
        "HotSpot", "the heat loss does not impair the surface", None, "later_claims", "later_idr_heat", "later_idr",
        SEEN_ERROR, NO_LARGER, why="not known",
    ),
    Claim(
        "Coiffier 2024", "no march overshoots on a 1-Lipschitz network",
        test="test_a_march_with_alpha_1_loses_no_pixel",
    ),
    Claim(
        "Neuralangelo 2023", "differences of values suit a hash grid better than its derivatives",
        why="needs a hash grid with such slopes in task=reconstruction",
    ),
    Claim(
        "Vicini 2022, Bangaru 2022", "reparameterised rays have an outline's gradient without bias",
        why="needs a field with second derivatives: see Not implemented in renderers/README.md",
    ),
)  # fmt: skip
NOTES = (
    *claims.RULES,
    "Outlines: a prior's code is fitted to one mask, see the page outline. Photographs: 600 iterations on 16 "
    "photographs of 40 x 40 pixels with masks, all rows with IDR's mask loss and one learning rate. The error is over "
    "what photographs see.",
    "The papers' own scenes, networks and training lengths are others. So a claim that does not hold here may hold "
    "there.",
    "The weight of the heat loss is 0.01, the best of 0.01, 0.1 and 1 on four validation shapes. The standard "
    "deviation of blurred points is 0.02 scene units at the start, and falls to 0.",
)


def make(*sources: Runs | None) -> Result:
    """A line for each claim."""
    runs = dict(zip(EXPERIMENTS, sources, strict=True))
    question = "Which claims of papers after 2020 hold in our measurements?"
    return claims.page(CLAIMS, runs, "Claims of later papers.", question, NOTES)


PAGES = {"later_claims": make}
