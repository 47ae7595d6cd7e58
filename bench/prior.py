"""`python -m bench.prior dataset=sofa`: trains the prior of a dataset, or finds it, and prints its path.

With `plan=true` it says what would be trained, and how long like trainings took, and trains nothing.
"""

import sys
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from bench.run.command import command_line


def main() -> int:
    """Finds or trains the prior; prints its path."""
    planned: list[Any] = []

    def train(config: DictConfig) -> None:
        from bench.config import build
        from bench.machine.environment import pick_device
        from bench.progress import run_progress
        from bench.shape_prior.store import find, make_prior, prior_settings

        dataset = build(config.dataset, "dataset", list(config.packages))
        settings, folder = prior_settings(config), Path(config.priors_dir)
        path, device = find(dataset, settings, folder), pick_device(config.device)
        if config.plan:
            from bench.run.trainings import prior_training, show_training

            show_training(prior_training(dataset, settings, folder, device), planned)
            return
        if path is None:
            with run_progress("prior") as progress:
                path = make_prior(dataset, settings, folder, device, progress)
        print(path)

    code = command_line(train, runs=False)
    if planned and code == 0:
        from bench.run.trainings import show_total

        show_total(planned)
    return code


if __name__ == "__main__":
    sys.exit(main())
