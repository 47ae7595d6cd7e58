"""The oracle of an experiment's shapes: the error of the prior's best fit to them, from the experiment `priors`."""

from typing import Any

from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import SCALE, error, setting, shape
from bench.report.data.statistics import median

PRIORS = Selection("priors", ("prior_fit",), ("dataset",))
LABEL = "oracle: the prior's fit to the truth"
NOTE = (
    "The oracle is a code fitted to the distances of the true mesh (+experiment=priors); it is shown where it was run "
    "on all of these shapes."
)


def oracles(experiment: Experiment, metric: str) -> dict[str, float]:
    """Median Chamfer x 1000 of the prior's fit, for each family of which all shapes were fitted.

    The fits must have been evaluated as the experiment was: with the same split, prior, grid and number of points.

    Args:
        experiment: experiment with the shapes.
        metric: "chamfer_l2" or another Chamfer metric.
    """
    fits = experiment.other(PRIORS)
    if fits is None or _evaluation(fits.requested()) != _evaluation(experiment.requested()):
        return {}
    found = {shape(record): SCALE * error(record, metric) for record in fits.records}
    wanted = {name: {shape(record) for record in records} for name, records in experiment.families().items()}
    complete = {name: shapes for name, shapes in wanted.items() if shapes <= set(found)}
    return {name: float(median([found[one] for one in shapes])) for name, shapes in complete.items()}


def _evaluation(config: dict[str, Any]) -> list[Any]:
    """The settings on which an evaluation depends."""
    paths = (("split",), ("prior",), ("evaluation", "grid"), ("evaluation", "points"))
    return [setting(config, *path) for path in paths]
