"""Claims of papers after 2020, as ratios of two errors or costs of measured runs."""

from bench.report.claims import NO_LARGER, RULES, SEEN_ERROR, SMALLER, Claim, page
from bench.report.study import Result, Runs, Selection

PLACE = 6
EXPERIMENT = "later_claims"
UNDECIDED = "too few shapes, or no effect in this setting"
READS = (Selection(EXPERIMENT, setup=(), may_differ=("field",)),)


def _claim(paper: str, text: str, row: str, reference: str, expected: tuple[float, float] = SMALLER) -> Claim:
    return Claim(paper, text, None, EXPERIMENT, row, reference, SEEN_ERROR, expected, why=UNDECIDED)


CLAIMS = (
    _claim("Objects as Volumes", "a smaller error than NeuS with as many samples", "later_opaque", "later_neus"),
    _claim(
        "Objects as Volumes", "a smaller error than VolSDF, which takes 96 further samples to place its 40",
        "later_opaque", "later_volsdf",
    ),
    _claim(
        "Radiance Surfaces", "a colour loss on each sample has a smaller error than one on the blended colour",
        "later_neus_samples", "later_neus",
    ),
    _claim(
        "Stochastic preconditioning", "blurred points reduce the error of a hash grid", "later_hash_blur", "later_hash"
    ),
    _claim(
        "HotSpot", "the heat loss does not impair the surface (error at most 25 % larger)", "later_idr_heat",
        "later_idr", NO_LARGER,
    ),
    Claim(
        "HotSpot", "a march needs fewer evaluations on a field that was learnt with the heat loss", None, EXPERIMENT,
        "later_idr_heat", "later_idr", "own_evaluations", why=UNDECIDED,
    ),
    Claim(
        "Coiffier 2024", "no march overshoots on a 1-Lipschitz network",
        test="test_a_march_with_alpha_1_loses_no_pixel",
    ),
    _claim(
        "Neuralangelo 2023", "differences of values as slopes of a hash grid reduce its error", "later_hash_slopes",
        "later_hash",
    ),
    Claim(
        "Vicini 2022, Bangaru 2022", "reparameterised rays have an outline's gradient without bias",
        why="needs a field with second derivatives: see Not implemented in renderers/README.md",
    ),
)  # fmt: skip
NOTES = (
    *RULES,
    "The claims are in our words and for our setting: 600 iterations on 16 photographs of 40 x 40 pixels with masks. "
    "All rows have IDR's mask loss at a sharpness of 200, and one learning rate. The error is over what photographs "
    "see.",
    "The papers have other scenes, larger networks and longer trainings. A claim that does not hold here may hold "
    "there.",
    "The weight of the heat loss is 0.01, the best of 0.01, 0.1 and 1 on four validation shapes. The standard "
    "deviation of blurred points is 0.02 scene units at the start, and falls to 0. Differences of a hash grid are over "
    "0.066 scene units, two cells of its finest level. In Neuralangelo, they begin at a coarse level.",
    "Evaluations of a march are those of rendering the held-out photographs at the end, per ray.",
)


def make(runs: Runs | None) -> Result:
    question = "Which claims of papers after 2020 hold in our measurements?"
    return page(CLAIMS, {EXPERIMENT: runs}, "Claims of later papers.", question, NOTES)


PAGES = {"later_claims": make}
