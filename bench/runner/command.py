"""The command line: arguments become a run or a sweep, and every mistake becomes one clear message."""

import os
import re
import sys
import textwrap
import traceback
from argparse import ArgumentError, ArgumentParser, Namespace
from collections.abc import Callable
from pathlib import Path

from hydra.errors import HydraException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationKeyError, OmegaConfBaseException

from bench.config import type_of
from bench.progress import notice
from bench.records.results import PlannedRun, write_error_message
from bench.runner.compose import Composer, composing, parse_override, without_hydra
from bench.runner.messages import OPTIONAL_GROUPS, Interrupted, quoted
from bench.runner.process import catch_signals, forget_signals, raise_if_stopped, stopped_by
from bench.runner.sweep import LauncherStopped, work_per_cell
from bench.tables import extension, names, nearest

DANGLING_COMMA = re.compile(r"[=,]\s*,|,\s*$")
SETTING_PATTERN = re.compile(r"(\+*([\w.]+))=(.+)", re.DOTALL)  # groups: plus signs and key, key, value
LISTED_GROUPS = ("task", "renderer", "dataset", "stress", "method", "experiment", "scale", "effort")
HELP = """
    python -m bench task=completion renderer=dist                          one run
    python -m bench -m renderer=dist,dvr,newton seed=0,1,2 dataset=sofa,plane     a sweep: every combination
    python -m bench -m +experiment=table1 scale=smoke                      all runs of a table, small ones
    python -m bench -m renderer=dist,dvr plan=true                         what would run, and for how long
    python -m bench dataset=mesh dataset.path=chair.obj                    your own mesh
    python -m bench renderer=custom renderer._target_=mypkg.Mine           your own renderer
    python -m bench list                                                   the tasks, renderers, datasets, experiments
    python -m bench.ray dataset=torus renderer=dist,newton                 what renderers do along one ray
    python -m bench.report                                                 tables, figures and results/local/index.html

Any setting is KEY=VALUE: seed=1, threads=2, time_limit=600, results_dir=PATH, task.points=50, renderer.steps=30.
--cfg job shows all settings and runs nothing; --config-dir PATH adds a folder of YAML."""
MAX_MESSAGE_LETTERS, LINE_LETTERS = 400, 100  # a longer message, such as a list of all names, has several lines
EXIT_FAILURE, EXIT_USAGE = 1, 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as in shells
KERNELS_VARIABLE = "IMPLICIT_BENCH_KERNELS"  # defined in renderers/kernels/library.py, which imports torch
FIELD_FILE_OVERRIDES = ("field=file", "field_path=")
SWEEP_OPTIONS = ("--multirun", "-m")
OPTIONS = (*SWEEP_OPTIONS, "--config-dir", "-cd", "--cfg", "-c", "--resolve", "--help", "-h")
Work = Callable[[PlannedRun], object]  # of one configuration; returns the status if that is a run
Sweep = Callable[[Composer, DictConfig], list[str]]  # makes the runs of a sweep; returns their statuses


def command_line(work: Work, sweep: Sweep | None = None) -> int:
    """Runs the command line.

    Args:
        work: of a single configuration.
        sweep: makes the runs of a sweep; None does `work` for each cell, in a command that makes no runs.

    Returns:
        the exit status: 0, 1 if a run did not end ok, or that of a mistake, which is printed on standard error.
    """
    catch_signals()
    try:
        if (text := _help_text(sys.argv[1:], sys.modules["__main__"].__doc__ or "")) is not None:
            print(text, flush=True)
            return 0
        all_ok = _compose_and_run(sys.argv[1:], work, sweep)
        raise_if_stopped()  # a library may have swallowed the exception
        return 0 if all_ok else EXIT_FAILURE
    except BrokenPipeError:  # `| head` reads only a part
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return EXIT_FAILURE
    except (KeyboardInterrupt, Exception) as error:
        if stopped := stopped_by(error):  # also if a library turned the signal into another error
            text = stopped if isinstance(error, Interrupted) else f"{stopped}; nothing was run"
            return _print_error(text, EXIT_INTERRUPTED)
        if isinstance(error, HydraException | OmegaConfBaseException | ValueError):  # one of Hydra's is also an OSError
            text = message_of(error)
            text = extension("typed_field_keys")(text) if "field=file" in sys.argv else text
            return _print_error(_add_file(text), EXIT_USAGE)
        if isinstance(error, OSError | LauncherStopped):
            return _print_error(write_error_message(error) if isinstance(error, OSError) else str(error))
        raise
    finally:
        forget_signals()


def _compose_and_run(arguments: list[str], work: Work, sweep: Sweep | None) -> bool:
    """Composes the configuration and runs it; returns whether all runs ended ok.

    Raises:
        ValueError: if an argument or the configuration is invalid.
    """
    options = options_of(arguments)
    if (kernels := os.environ.get(KERNELS_VARIABLE)) not in (None, "", "torch", "compiled"):
        raise ValueError(f"{KERNELS_VARIABLE} must be torch or compiled, not {kernels!r}: unset it for compiled")
    with composing(*config_dirs(options)):
        composer = Composer([quote_text(text) for text in overrides_of(options)])
        config = composer.shared_config()
        if options.cfg:
            composer.check_keys()
            print(OmegaConf.to_yaml(without_hydra(config), resolve=options.resolve), end="")
            return True
        if sweep is None and config.plan:
            raise ValueError("plan=true lists runs, and this command starts none: remove it")
        os.environ |= {str(key): str(value) for key, value in config.hydra.job.env_set.items()}
        if options.multirun or config.hydra.mode == RunMode.MULTIRUN:
            if sweep is not None:
                return all(status == "ok" for status in sweep(composer, config))
            return work_per_cell(composer, config, work)
        params = OmegaConf.select(config, "hydra.sweeper.params")
        run = composer.single_run(config)
    if params and sweep is not None:
        notice("note: this is one run; with -m in the command it is all runs of the table")
    return work(run) in (None, "ok")


def _help_text(arguments: list[str], about: str) -> str | None:
    """The help, or the list of choices, if the command line asks for one of them, else None."""
    is_help = bool({"--help", "-h", "help"} & {*arguments})
    if not is_help and "list" not in arguments:
        return None
    groups = ("task", "renderer", "dataset", "scale") if is_help else LISTED_GROUPS
    listed = "\n".join(f"{group}: {', '.join(_choice_names(group))}" for group in groups)
    return f"{about.strip()}\n{HELP}\n\n{listed}" if is_help else f"{listed}\nconf/README.md has their meanings"


def options_of(arguments: list[str]) -> Namespace:
    """The options of a command line, in any position, and its overrides.

    Raises:
        ValueError: if an option is unknown or lacks its value.
    """
    parser = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("overrides", nargs="*")
    parser.add_argument(*SWEEP_OPTIONS, action="store_true")
    parser.add_argument("--config-dir", "-cd")
    parser.add_argument("--cfg", "-c", choices=("job",))
    parser.add_argument("--resolve", action="store_true")
    try:
        options, unknown = parser.parse_known_intermixed_args(arguments)
    except ArgumentError as error:
        raise ValueError(f"{error.argument_name}: {error.message}") from error
    for option in unknown:
        key = option.lstrip("-").partition("=")[0]
        if key and (names(key) or type_of(key) is not None):
            raise ValueError(f"unknown option {option!r}: settings have no dashes, write {key}=VALUE")
        raise ValueError(f"unknown option {option!r}{nearest(option, sorted(OPTIONS))}")
    return options


def config_dirs(options: Namespace) -> list[Path]:
    """The user's folder of configurations and tables, if the command names one."""
    return [Path(options.config_dir)] if options.config_dir else []


def overrides_of(options: Namespace) -> list[str]:
    """The overrides of a command line, with those of a dataset in place of `field=file field_path=PATH`."""
    names_file = any(text.startswith(FIELD_FILE_OVERRIDES) for text in options.overrides)
    return extension("field_file")(options.overrides) if names_file else options.overrides


def quote_text(argument: str) -> str:
    """Quotes text that Hydra would read as a number, a boolean or null, if the key is a path or its type is text.

    Without quotes, `label=1e3` would become 1000.0, `label=Nan` nan, and `label=true` True. In a path, `~` is the home
    folder. A path that Hydra cannot read, or a file whose name has a comma, becomes one quoted text.
    """
    setting = SETTING_PATTERN.fullmatch(argument)
    is_path = setting is not None and setting[2].endswith("path")
    if setting is None or not (is_path or type_of(setting[2]) in (str, str | None)):
        return argument
    in_home = re.fullmatch(r"""(["']?)(~.*)\1""", setting[3]) if is_path else None
    text = str(Path(in_home[2]).expanduser()) if in_home else setting[3]
    try:
        values = [(word, parse_override(f"text={word}").value()) for word in text.split(",")]
    except HydraException:  # a comma within quotes or brackets, no value, or a text that Hydra cannot read
        return f"{setting[1]}={quoted(text)}" if is_path and text[0] not in "'\"[" else argument
    if "," in text and is_path and Path(text).exists():
        return f"{setting[1]}={quoted(text)}"
    typed = [quoted(word.strip()) if isinstance(value, int | float) else word for word, value in values]
    return f"{setting[1]}={','.join(typed)}"


def _print_error(message: str, exit_status: int = EXIT_FAILURE) -> int:
    if any(argument.replace(" ", "").lower() == "verbose=true" for argument in sys.argv[1:]):
        traceback.print_exc()
    text = f"error: {message}"
    if len(text) > MAX_MESSAGE_LETTERS:
        text = textwrap.fill(text, LINE_LETTERS, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
    print(text, file=sys.stderr)
    return exit_status


def message_of(error: Exception) -> str:
    """The error message in one line."""
    if isinstance(error, OverrideParseException):
        return _override_message(error.override)
    text = " ".join(str(error).split())
    is_shell = isinstance(error, InterpolationKeyError) and re.search(r"Interpolation key '[A-Z]\w*'", text)
    hint = ": ${...} in quotes is a key of the configuration; for a shell variable remove the quotes"
    return f"{text}{hint if is_shell else ''}"


def _add_file(message: str) -> str:
    """Adds the file of the user's folder that has the key to a message on an unknown key; keeps other messages."""
    if (match := re.search(r"(?:has no|unknown) key '([^']+)'", message)) is None:
        return message
    key = re.compile(rf"\b{re.escape(match[1])}\b[\w.]*\s*:")
    files = [path for folder in config_dirs(options_of(sys.argv[1:])) for path in sorted(folder.rglob("*.yaml"))]
    return message + next((f" It is in {path}" for path in files if key.search(path.read_text("utf-8", "replace"))), "")


def _override_message(override: str) -> str:
    """The error message for an override that Hydra cannot parse."""
    for group in LISTED_GROUPS:
        if override in _choice_names(group):
            plus = "+" if group in OPTIONAL_GROUPS else ""
            return f"{override!r} is no setting: write {plus}{group}={override}"
    if DANGLING_COMMA.search(override):
        return f"{override!r} has a comma without a value beside it: write key=a,b"
    return f"cannot read {override!r}: write key=value, and quote a value with special characters as 'key=\"value\"'"


def _choice_names(group: str) -> list[str]:
    return [name for name in names(group) if not name.startswith("_")]
