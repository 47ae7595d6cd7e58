"""Model selection over FLOPs per query: the panels of `parsimony` with another horizontal axis."""

from bench.report.data.experiments import Experiment
from bench.report.data.parsimony import PARSIMONY, named_settings, scene_runs
from bench.report.pages.parsimony import CANDIDATE, INTERVAL, NOTES, SCENE, candidate_lines, draw, of_candidate
from bench.report.write.caption import WITHOUT_NETWORK, captioned
from bench.report.write.result import Result
from bench.report.write.table import Column, through, to_data

PLACE = 170
READS = (PARSIMONY,)
QUERY = (
    "A query computes one value of the field; its floating-point operations are counted for networks, and estimated "
    "for formulas and grids."
)
COLUMNS = (
    *through(lambda line: line[0], *SCENE, Column("footprint")),
    *through(of_candidate, *CANDIDATE, *map(Column, ("flops_per_query", "error", "standard_error", "failed"))),
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a panel per scene over FLOPs per query."""
    runs = scene_runs(experiment)
    about = named_settings(experiment)
    return Result(
        title="Error over the cost of a query of the field.",
        **captioned(
            experiment,
            "Held-out error of each candidate over its FLOPs per query, a panel per scene.",
            interval=INTERVAL,
            notes=(QUERY, *(note.format(**about) for note in NOTES)),
            parts=WITHOUT_NETWORK,
        ),
        data=to_data(COLUMNS, candidate_lines(runs)),
        figure=draw(runs, "flops_per_query"),
    )
