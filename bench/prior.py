"""`python -m bench.prior dataset=sofa`: finds or trains the prior of a dataset, or of `prior.of`; prints its path."""

import sys

from bench.records.folder import Identity
from bench.run.command import command_line


def train(run: Identity) -> None:
    """Finds or trains the prior; prints its path.

    Raises:
        ValueError: for what cannot be trained.
    """
    from bench.machine.environment import flushing_denormals
    from bench.progress import run_progress
    from bench.setup.inputs import cell_of
    from bench.shape_prior import PriorSettings, prior_file
    from datasets.network_files import Networked

    cell = cell_of(run.config)
    inputs, settings = cell.inputs, cell.prior
    if isinstance(inputs.dataset, Networked) or not isinstance(settings, PriorSettings):
        raise ValueError("the codes of a network are the prior already: there is nothing to train")
    inputs.check_prior()
    with flushing_denormals(), run_progress("prior") as progress:
        path = prior_file(cell.learnt, settings, inputs.cache, inputs.device, progress)
    print(path)


def main() -> int:
    """Trains what the command line describes; gives the exit status."""
    return command_line(train)


if __name__ == "__main__":
    sys.exit(main())
