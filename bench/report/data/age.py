"""Notes on runs and pages of earlier versions: removed settings, the engine behind the times, old statistics."""

import subprocess
from functools import cache
from pathlib import Path

from bench.report.data.records import Record, grouped, row_of
from bench.tables import CONF, LABEL_KEY, read_yaml

RESTORED_FIELD = "restored"  # the page and version from whose CSV a record without a run folder was restored
COMPILED_SINCE = "2026-11-26"  # from this day on, compiled code evaluates fields on one thread of a CPU
UNKNOWN = "unknown"
REMOVED_SETTINGS = {  # their value that equals the behaviour of this version, and the effect of another value
    "keep_slope_sign": (True, "which turned the sign of the gradient at flat crossings"),
}
ENGINE = (
    f"Before {COMPILED_SINCE}, PyTorch computed all field values. Since then, compiled code computes those of ReLU "
    "networks without a gradient, on one thread of a CPU. Times and their ratios therefore differ."
)


def notes(records: list[Record]) -> list[str]:
    """Notes on runs of earlier versions; empty if there are none."""
    return [note for note in (_old_rows(records), _engine(records), _restored(records)) if note]


def removed_settings(record: Record) -> list[str]:
    """The recorded settings of the renderer, as KEY=VALUE, that this version does not have. Such a row is old."""
    settings = record["config"].get("renderer") or {}
    arguments = _arguments().get(settings.get("_target_"), settings)
    return [
        f"{key}={value}{', ' if key in REMOVED_SETTINGS else ''}{REMOVED_SETTINGS.get(key, ('', ''))[1]}"
        for key, value in settings.items()
        if key not in arguments and (key not in REMOVED_SETTINGS or REMOVED_SETTINGS[key][0] != value)
    ]


@cache
def _arguments() -> dict[str, set[str]]:
    """The settings of each class of conf/renderer, and those that variants set."""
    files = [read_yaml(path) for path in sorted((CONF / "renderer").glob("*.yaml"))]
    classes = grouped(files, lambda file: str(file["_target_"]))
    variants = read_yaml(CONF / "variants.yaml").values()
    return {target: {LABEL_KEY}.union(*settings, *variants) for target, settings in classes.items()}


def _old_rows(records: list[Record]) -> str:
    pairs = [(setting, row_of(record).name) for record in records for setting in removed_settings(record)]
    listed = [
        f"{', '.join(dict.fromkeys(row for _, row in row_pairs))} ({len(row_pairs)} runs with {setting})"
        for setting, row_pairs in grouped(pairs, lambda pair: pair[0]).items()
    ]
    return f"Old rows, with settings that this version does not have: {'; '.join(listed)}." if listed else ""


def _engine(records: list[Record]) -> str:
    """A note on times of an earlier engine: their records do not name the engine."""
    environments = [record["environment"] for record in records if record["environment"]]
    unnamed = [
        each
        for each in environments
        if "kernels" not in each and (each.get("device"), each.get("threads")) == ("cpu", 1)
    ]
    if not unnamed:
        return ""
    subject = "Times" if len(unnamed) == len(environments) else f"Times of {len(unnamed)} of {len(environments)} runs"
    return f"{subject} are of earlier versions. {ENGINE}"


def _restored(records: list[Record]) -> str:
    sources = sorted({record[RESTORED_FIELD] for record in records if RESTORED_FIELD in record})
    if not sources:
        return ""
    return (
        f"Rows are restored from {', '.join(sources)}, as their run folders are gone. They have only the settings "
        "that this page shows."
    )


def drawn_by(path: Path) -> str:
    """The version that drew a file: the last commit that changed it, with its date."""
    command = ["git", "log", "-1", "--format=%h of %cs", "--", path.name]
    try:
        log = subprocess.run(command, cwd=path.parent, capture_output=True, text=True, check=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return UNKNOWN
    return log.stdout.strip() or UNKNOWN


def head(version: str) -> str:
    """The head of a page that this version cannot draw; empty if no other version drew it."""
    if not version:
        return ""
    day = version.rpartition(" ")[2]
    engine = f" {ENGINE}" if version != UNKNOWN and day < COMPILED_SINCE else ""
    return (
        f"Drawn by version {version}, with its statistics; this version cannot draw it without the run folders.{engine}"
    )
