"""`python -m bench.train task=single_view dataset=car`: trains the network that the task needs, and prints its path.

With `plan=true` it says what would be trained, and how long like trainings took, and trains nothing.
"""

import sys
from typing import Any

from omegaconf import DictConfig, OmegaConf

from bench.run.command import command_line


def main() -> int:
    """Finds or trains the network; prints its path. A training that was stopped goes on where it was."""
    planned: list[Any] = []

    def train(config: DictConfig) -> None:
        from bench.config import build
        from bench.progress import run_progress
        from bench.setup.inputs import set_up
        from bench.tasks.single_view import OneImage, told

        task = build(config.task, "task", list(config.packages))
        if not isinstance(task, OneImage):
            raise ValueError(
                "bench.train trains the network of task=single_view: python -m bench.train +method=single_view "
                "dataset=car; python -m bench.prior trains a prior"
            )
        plain = OmegaConf.to_container(config, resolve=True)
        assert isinstance(plain, dict)
        with run_progress("single_view") as progress:
            inputs = set_up(config, progress)
            recipe = task.recipe(inputs, {str(key): value for key, value in plain.items()})
            if config.plan:
                from bench.run.trainings import network_training, show_training

                show_training(network_training(recipe, inputs.cache, inputs.device), planned)
                return
            path = recipe.make(inputs.cache, inputs.device, progress)
        print(told(recipe.load(path)[1]), file=sys.stderr)
        print(path)

    code = command_line(train, runs=False)
    if planned and code == 0:
        from bench.run.trainings import show_total

        show_total(planned)
    return code


if __name__ == "__main__":
    sys.exit(main())
