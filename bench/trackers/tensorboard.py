"""TensorBoard: an event file in each run folder, with the curve, the last values and the settings."""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from bench.trackers.content import curve, settings, values


@dataclass(frozen=True)
class TensorBoard:
    """Exports to event files.

    Args:
        folder: under which each run has a folder of its name.
    """

    folder: str

    def __post_init__(self) -> None:
        if find_spec("tensorboard") is None:  # now, not after a night of runs
            raise ValueError("tracker=tensorboard needs TensorBoard: pip install -e '.[tensorboard]'")

    def export(self, folder: Path, record: dict[str, Any]) -> None:
        """Writes the run's event file."""
        from torch.utils.tensorboard import SummaryWriter  # slow, and needed only now

        with SummaryWriter(str(Path(self.folder) / record["id"])) as writer:
            for iteration, line in curve(folder):
                for name, value in line.items():
                    writer.add_scalar(f"curve/{name}", value, iteration)
            for name, value in values(record).items():
                writer.add_scalar(name.replace(".", "/"), value, 0)
            told = {"status": record["status"], "reason": record["reason"], **settings(record["config"])}
            writer.add_text("settings", "\n".join(f"    {name}: {text}" for name, text in told.items()))
