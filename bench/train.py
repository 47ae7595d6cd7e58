"""`python -m bench.train task=single_view dataset=car`: trains the network that the task needs, and prints its path."""

import sys

from bench.records.results import PlannedRun
from bench.runner.command import command_line


def train(run: PlannedRun) -> None:
    """Finds or trains the network; prints its path. A stopped training continues.

    Raises:
        ValueError: if the task has no network.
    """
    from bench.machine.environment import flushing_denormals
    from bench.progress import run_progress
    from bench.setup.inputs import prepare_run
    from bench.tasks.single_view.task import OneImage, describe_training

    task, inputs = prepare_run(run.config)
    if not isinstance(task, OneImage):
        raise ValueError(
            "bench.train trains the network of task=single_view: python -m bench.train +method=single_view "
            "dataset=car; python -m bench.prior trains a prior"
        )
    with flushing_denormals(), run_progress("single_view") as progress:
        inputs.configure_process()
        recipe = task.recipe(inputs, run.config)
        path = recipe.make(inputs.cache, inputs.device, progress)
    print(describe_training(recipe.load(path)[1]), file=sys.stderr)
    print(path)


def main() -> int:
    return command_line(train)


if __name__ == "__main__":
    sys.exit(main())
