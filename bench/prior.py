"""`python -m bench.prior dataset=sofa`: finds or trains the prior of a dataset, or of `prior.of`; prints its path."""

import sys

from bench.records.results import PlannedRun
from bench.runner.command import command_line


def train(run: PlannedRun) -> None:
    """Finds or trains the prior; prints its path.

    Raises:
        ValueError: if nothing can be trained.
    """
    from bench.machine.environment import flushing_denormals
    from bench.progress import run_progress
    from bench.setup.inputs import prepare_run
    from bench.shape_prior import PriorSettings, prior_file

    _, inputs = prepare_run(run.config)
    choice = inputs.prior_choice
    if not isinstance(choice.source, PriorSettings):
        raise ValueError("the codes of a network are the prior already: there is nothing to train")
    inputs.check_prior()
    with flushing_denormals(), run_progress("prior") as progress:
        path = prior_file(choice.dataset, choice.source, inputs.cache, inputs.device, progress)
    print(path)


def main() -> int:
    return command_line(train)


if __name__ == "__main__":
    sys.exit(main())
