"""`python -m bench.prior dataset=sofa`: trains the prior of a dataset, or finds it, and prints its path."""

import sys
from pathlib import Path

from omegaconf import DictConfig

from bench.run.command import command_line


def main() -> int:
    """Finds or trains the prior; prints its path."""

    def train(config: DictConfig) -> None:
        from bench.config import build
        from bench.machine.environment import pick_device
        from bench.progress import run_progress
        from bench.shape_prior.store import find, make_prior, prior_settings

        dataset = build(config.dataset, "dataset", list(config.packages))
        settings = prior_settings(config)
        path = find(dataset, settings, Path(config.priors_dir))
        if path is None:
            with run_progress("prior") as progress:
                path = make_prior(dataset, settings, Path(config.priors_dir), pick_device(config.device), progress)
        print(path)

    return command_line(train)


if __name__ == "__main__":
    sys.exit(main())
