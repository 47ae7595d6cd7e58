"""Exports runs to TensorBoard: an event file per run, with the curve, the final values and the settings."""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from bench.trackers import curve, settings, values
from datasets.extras import install


@dataclass(frozen=True)
class TensorBoard:
    """Exports to event files.

    Args:
        folder: under which each run has a folder of its name.
    """

    folder: str

    def __post_init__(self) -> None:
        if find_spec("tensorboard") is None:  # checked before the run, not after it
            raise ValueError(f"tracker=tensorboard needs TensorBoard: {install('tensorboard')}")

    def export(self, folder: Path, record: dict[str, Any]) -> None:
        """Writes the run's event file."""
        from torch.utils.tensorboard import SummaryWriter  # slow to import, and needed only here

        with SummaryWriter(str(Path(self.folder) / record["id"])) as writer:
            for iteration, line in curve(folder):
                for name, value in line.items():
                    writer.add_scalar(f"curve/{name}", value, iteration)
            for name, value in values(record).items():
                writer.add_scalar(name.replace(".", "/"), value, 0)
            summary = {"status": record["status"], "reason": record["reason"], **settings(record["config"])}
            writer.add_text("settings", "\n".join(f"    {name}: {text}" for name, text in summary.items()))
