"""A known shape as no more of a field than it needs: for tasks whose unknown is something else."""

from bench.ladder.fit import Fitter
from bench.ladder.growth import grow
from bench.ladder.views import Views
from bench.stage import Cell
from bench.tasks.given import Weights
from bench.tasks.problem import check_field_gradient
from datasets.truth import Truth
from renderers.field import Field


def grown_shape(cell: Cell, weights: Weights) -> Field:
    """The scene's shape as the field that the run asks for, grown from views of it (`field=auto`), or of one rung.

    It is done before the task's own clock begins.

    Args:
        cell: the run, whose record notes what was grown.
        weights: of a view's loss.

    Raises:
        Unsupported: where the renderer has no gradient towards the field.
        ValueError: where no field could be fitted.
    """
    check_field_gradient(cell.stage.renderer)
    stage, ladder = cell.stage, cell.stage.ladder
    views = Views(Truth(stage.scene.mesh), stage.views, ladder.views, weights, stage.renderer, stage.device)
    fitter = Fitter(views.observations(stage.seed), ladder.fit, stage.seed, stage.device, lambda name, line: None)
    growth = grow(fitter, ladder.asked(stage.field), ladder.growth)
    if growth.fitted.failed:
        raise ValueError(
            f"no field was found for the known shape: {growth.fitted.evidence.reason}; field=prior takes it whole"
        )
    cell.record.notes = [*cell.record.notes, *growth.told(stage.field)]
    return growth.fitted.model.frozen()
