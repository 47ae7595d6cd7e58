"""The oracle of a table's shapes: the error of the prior's best fit to the truth, from the experiment `priors`."""

from typing import Any

from bench.report.data.records import error, setting, shape
from bench.report.data.runs import Runs, Selection
from bench.report.data.statistics import median

PRIORS = Selection("priors")
LABEL = "oracle: the prior's fit to the truth"
NOTE = "The oracle is a code fitted to the distances of the true mesh (`+experiment=priors`), of all of these shapes."


def oracles(runs: Runs, metric: str, scale: float = 1000.0) -> dict[str, float]:
    """The median Chamfer, times `scale`, of the prior's fit, of each family of which all shapes were fitted.

    The fits must have been judged as the runs were: with the same split, prior, grid and number of points.
    """
    fits = runs.other(PRIORS)
    if fits is None or _judged(fits.requested()) != _judged(runs.requested()):
        return {}
    found = {shape(record): scale * error(record, metric) for record in fits.records}
    wanted = {name: {shape(record) for record in records} for name, records in runs.families().items()}
    complete = {name: shapes for name, shapes in wanted.items() if shapes <= set(found)}
    return {name: float(median([found[one] for one in shapes])) for name, shapes in complete.items()}


def _judged(config: dict[str, Any]) -> list[Any]:
    """The settings on which an evaluation depends."""
    paths = (("split",), ("prior",), ("evaluation", "grid"), ("evaluation", "points"))
    return [setting(config, *path) for path in paths]
