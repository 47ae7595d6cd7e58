"""The command line: what is typed becomes a run or a sweep, and every mistake one clear line."""

import os
import re
import sys
import traceback
from argparse import ArgumentError, ArgumentParser, Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydra.errors import HydraException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bench.config import type_of
from bench.progress import notice
from bench.records.folder import Identity
from bench.run.compose import NOT_BY_DEFAULT, Composer, composing, parsed, without_hydra
from bench.run.job import Interrupted, unwritten
from bench.run.process import catch_signals, forget_signals, leave_server, raise_if_stopped, stopped_by
from bench.run.sweep import LauncherStopped, do_each
from bench.tables import names, nearest

COMMA = re.compile(r"[=,]\s*,|,\s*$")  # without a value beside it
SETTING = re.compile(r"(\+*(\w+))=(.+)", re.DOTALL)  # of the top level: before its value, its key, its value
GROUPS = ("task", "renderer", "dataset", "stress", "method", "experiment", "scale")  # that `list` shows
HELP = """
    python -m bench task=completion renderer=dist                          one run
    python -m bench -m renderer=dist,dvr,newton seed=0,1,2 dataset=sofa,plane     a sweep: every combination
    python -m bench -m +experiment=table1 scale=smoke                      all runs of a table, small ones
    python -m bench -m renderer=dist,dvr plan=true                         what would run, and for how long
    python -m bench dataset=mesh dataset.path=chair.obj                    your own mesh
    python -m bench renderer=custom renderer._target_=mypkg.Mine           your own renderer
    python -m bench list                                                   the tasks, renderers, datasets, experiments
    python -m bench.report                                                 tables, figures and results/local/index.html

Any setting is KEY=VALUE: seed=1, threads=2, time_limit=600, results_dir=PATH, task.points=50, renderer.steps=30.
--cfg job shows all settings and runs nothing; --config-dir PATH adds a folder of YAML."""
USAGE = 2  # exit status of a wrong command line
FAILED = 1
AS_TYPED = {"dataset.path: ": "field_path: ", "dataset.module.": "field."}  # with field=file; see `with_network`
INTERRUPTED = 130  # 128 + SIGINT, as shells have it
KERNELS = "IMPLICIT_BENCH_KERNELS"  # see renderers/kernels/library.py, whose import takes that of torch
SWEEP = ("--multirun", "-m")
OPTIONS = (*SWEEP, "--config-dir", "-cd", "--cfg", "-c", "--resolve", "--help", "-h")
Job = Callable[[Identity], object]  # does what a configuration describes, and gives the status where that is a run
Sweep = Callable[[Composer, DictConfig], list[str]]  # makes the runs of a sweep, and gives their statuses


def command_line(job: Job, sweep: Sweep | None = None) -> int:
    """Does what the command line describes.

    Args:
        job: what a single configuration asks for.
        sweep: what a sweep asks for; None does the job of each cell, which is no run.

    Returns:
        the exit status: 0, 1 where a run did not end ok, or the status of a mistake that was printed on standard error.
    """
    if (text := _answer(sys.argv[1:], sys.modules["__main__"].__doc__ or "")) is not None:
        return _print(text)
    catch_signals()
    typed = AS_TYPED if "field=file" in sys.argv else {}
    try:
        done = _carry_out(sys.argv[1:], job, sweep)
        raise_if_stopped()  # also where a library swallowed it
        return 0 if done else FAILED
    except KeyboardInterrupt as error:
        return _stopped(error)
    except (HydraException, OmegaConfBaseException, ValueError) as error:  # one of Hydra's is an OSError too
        leave_server()
        text = message_of(error)
        for key, short in typed.items():
            text = text.replace(key, short)
        return _tell(_with_file(text), USAGE)
    except BrokenPipeError:  # `| head` has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return FAILED
    except OSError as error:
        return _stopped(error) if stopped_by(error) else _tell(unwritten(error))
    except LauncherStopped as error:
        return _tell(str(error))
    except Exception as error:
        if stopped_by(error):  # a library made another error of it
            return _stopped(error)
        raise
    finally:
        forget_signals()


def _carry_out(arguments: list[str], job: Job, sweep: Sweep | None) -> bool:
    """Composes what is typed and does it; gives whether all runs ended ok.

    Raises:
        ValueError: for what cannot be.
    """
    options = options_of(arguments)
    if (kernels := os.environ.get(KERNELS)) not in (None, "", "torch", "compiled"):
        raise ValueError(f"{KERNELS} must be torch or compiled, not {kernels!r}: unset it for compiled")
    with composing(*config_dirs(options)):
        composer = Composer([text_as_typed(text) for text in with_network(options.overrides)])
        config = composer.whole()
        if options.cfg:
            composer.check_keys()
            print(OmegaConf.to_yaml(without_hydra(config), resolve=options.resolve), end="")
            return True
        if options.multirun or config.hydra.mode == RunMode.MULTIRUN:
            if sweep is not None:
                return all(status == "ok" for status in sweep(composer, config))
            _refuse_plan(config)
            return do_each(composer, config, job)
        params = OmegaConf.select(config, "hydra.sweeper.params")
        os.environ |= {str(key): str(value) for key, value in config.hydra.job.env_set.items()}
        identity = composer.single(config)
    if sweep is None:
        _refuse_plan(identity.config)
    elif params:
        notice("note: this is one run; with -m in the command it is all runs of the table")
    return job(identity) in (None, "ok")


def _refuse_plan(config: Any) -> None:
    """Raises ValueError for plan=true in a command that makes no runs."""
    if config["plan"]:
        raise ValueError("plan=true lists runs, and this command starts none: remove it")


def _stopped(error: BaseException) -> int:
    """Says by which signal a command was stopped."""
    text = stopped_by(error)
    return _tell(text if isinstance(error, Interrupted) else f"{text}; nothing was run", INTERRUPTED)


def _answer(arguments: list[str], about: str) -> str | None:
    """The text that a command line asks for in place of a run; None where it asks for none."""
    helped = bool({"--help", "-h", "help"} & {*arguments})
    if not helped and "list" not in arguments:
        return None
    groups = ("task", "renderer", "dataset", "scale") if helped else GROUPS
    listed = "\n".join(f"{group}: {', '.join(_choices(group))}" for group in groups)
    return f"{about.strip()}\n{HELP}\n\n{listed}" if helped else listed


def _print(text: str) -> int:
    """Prints a text, of which `| head` may read a part; gives the exit status."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return 0


def options_of(arguments: list[str]) -> Namespace:
    """The options of a command line, which may stand anywhere, and its overrides.

    Raises:
        ValueError: for an unknown option, and one without its value.
    """
    parser = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("overrides", nargs="*")
    parser.add_argument(*SWEEP, action="store_true")
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
    """The folder of configurations that a command adds, which may have tables."""
    return [Path(options.config_dir)] if options.config_dir else []


def with_network(arguments: list[str]) -> list[str]:
    """The arguments with `field=file field_path=PATH`, a network as the scene's field, as the dataset that it is.

    With `field._target_=PACKAGE.CLASS` it is of that class; other keys of `field` are its arguments.

    Raises:
        ValueError: for one of the two without the other, or beside another dataset.
    """
    keys = [argument.partition("=")[0] for argument in arguments]
    if "field=file" not in arguments and "field_path" not in keys:
        return arguments
    if "field=file" not in arguments or "field_path" not in keys:
        raise ValueError("a network's file is the scene's field by field=file field_path=PATH: type both")
    if "dataset" in keys:
        raise ValueError("with field=file the network's own surface is the shape: remove dataset")
    own = "field._target_" in keys
    places = {"^field=file$": f"dataset={'module' if own else 'network'}", "^field_path=": "dataset.path="}
    places |= {r"^field\._target_=": "dataset.module._target_=", r"^field\.": "+dataset.module."} if own else {}
    for pattern, text in places.items():
        arguments = [re.sub(pattern, text, argument) for argument in arguments]
    return arguments


def text_as_typed(argument: str) -> str:
    """The argument, with quotes around what Hydra would read as a number where the key's value is a text.

    Without them, `label=1e3` would become 1000.0, `label=Nan` nan, and `label=true` True.
    """
    setting = SETTING.fullmatch(argument)
    if setting is None or type_of(setting[2]) not in (str, str | None):
        return argument
    try:
        values = [(text, parsed(f"text={text}").value()) for text in setting[3].split(",")]
    except HydraException:  # a comma within quotes or brackets, or no value
        return argument
    typed = [f"'{text.strip()}'" if isinstance(value, int | float) else text for text, value in values]
    return f"{setting[1]}={','.join(typed)}"


def _tell(message: str, code: int = FAILED) -> int:
    if any(argument.replace(" ", "").lower() == "verbose=true" for argument in sys.argv[1:]):
        traceback.print_exc()
    print(f"error: {message}", file=sys.stderr)
    return code


def message_of(error: Exception) -> str:
    """One line on what is wrong with what was typed."""
    return _unreadable(error.override) if isinstance(error, OverrideParseException) else " ".join(str(error).split())


def _with_file(message: str) -> str:
    """A message on a mistyped key, with the file of the user's folder that has it; other messages as they are."""
    if (match := re.search(r"(?:has no|unknown) key '([^']+)'", message)) is None:
        return message
    key = re.compile(rf"\b{re.escape(match[1])}\b[\w.]*\s*:")
    files = [path for folder in config_dirs(options_of(sys.argv[1:])) for path in sorted(folder.rglob("*.yaml"))]
    return message + next((f" It is in {path}" for path in files if key.search(path.read_text("utf-8", "replace"))), "")


def _unreadable(override: str) -> str:
    """One line on an override that Hydra cannot read."""
    for group in GROUPS:
        if override in _choices(group):
            plus = "+" if group in NOT_BY_DEFAULT else ""
            return f"{override!r} is no setting: write {plus}{group}={override}"
    if COMMA.search(override):
        return f"{override!r} has a comma without a value beside it: write key=a,b"
    return f"cannot read {override!r}: write key=value, and quote a value with special characters as 'key=\"value\"'"


def _choices(group: str) -> list[str]:
    return [name for name in names(group) if not name.startswith("_")]
