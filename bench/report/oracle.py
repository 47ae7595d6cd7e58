"""How well the prior can show the shapes of an experiment at best, from the priors experiment beside it."""

from typing import Any

from bench.report.experiments import Experiment, error, family, setting
from bench.report.statistics import median

SCALE = 1000.0
LABEL = "oracle: the prior's fit to the truth"


def oracles(experiment: Experiment, metric: str) -> dict[str, float]:
    """Median Chamfer x 1000 of the prior's fit to each family's shapes, of families of which every shape was fitted.

    The fits must have been judged as the experiment is: with the same split, prior, grid and number of points.

    Args:
        experiment: whose shapes they are.
        metric: "chamfer_l2" or another of its kind.
    """
    fits = experiment.beside("priors")
    if fits is None or _judged(fits.asked()) != _judged(experiment.asked()):
        return {}
    wanted, found = (
        {(family(r), r["config"].get("index")): SCALE * error(r, metric) for r in chosen.records}
        for chosen in (experiment, fits)
    )
    families = dict.fromkeys(name for name, _ in wanted)
    shapes = {name: [key for key in wanted if key[0] == name] for name in families}
    complete = [name for name in families if all(key in found for key in shapes[name])]
    return {name: float(median([found[key] for key in shapes[name]])) for name in complete}


def _judged(config: dict[str, Any]) -> list[Any]:
    paths = (("split",), ("prior",), ("evaluation", "grid"), ("evaluation", "points"))
    return [setting(config, *path) for path in paths]
