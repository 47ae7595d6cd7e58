"""`python -m bench.train task=single_view dataset=car`: trains the network that the task needs, and prints its path."""

import sys

from omegaconf import DictConfig, OmegaConf

from bench.run.command import command_line


def main() -> int:
    """Finds or trains the network; prints its path. A training that was stopped goes on where it was."""

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
            path = recipe.make(inputs.cache, inputs.device, progress)
        print(told(recipe.load(path)[1]), file=sys.stderr)
        print(path)

    return command_line(train)


if __name__ == "__main__":
    sys.exit(main())
