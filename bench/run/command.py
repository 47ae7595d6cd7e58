"""The command line: Hydra underneath, with one clear line for every mistake."""

import os
import re
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import hydra
from hydra import compose, initialize_config_dir
from hydra._internal.hydra import Hydra
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bench.config import register, type_of, wrong_type
from bench.records.folder import Identity, identify, resolved
from bench.run.compose import parsed
from bench.run.job import unwritten
from bench.run.pack import register_slurm
from bench.run.plan import Shown
from bench.run.process import catch_signals, forget_signals, leave_server, raise_if_stopped, stopped_by
from bench.run.sweep import Refused, Sweep
from bench.tables import CONF, names, nearest, register_resolvers
from datasets.extras import install

COMMA = re.compile(r"[=,]\s*,|,\s*$")  # without a value beside it
SETTING = re.compile(r"(\+*(\w+))=(.+)", re.DOTALL)  # of the top level: before its value, its key, its value
CHOICE = re.compile(r"(\w+)=(\w+)")  # of one YAML of a group
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
--cfg job shows all settings and runs nothing; --config-dir PATH adds a folder of YAML; --hydra-help is Hydra's own."""
USAGE = 2  # exit status of a wrong command line
FAILED = 1
AS_TYPED = {"dataset.path: ": "field_path: ", "dataset.module.": "field."}  # with field=file; see `with_network`
EXTRAS = {"joblib": "joblib", "submitit": "submitit", "ray": "ray"}  # by the beginning of a launcher's name
INTERRUPTED = 130  # 128 + SIGINT, as shells have it
KERNELS = "IMPLICIT_BENCH_KERNELS"  # see renderers/kernels/library.py, whose import takes that of torch


def command_line(job: Callable[[Identity], None], *, runs: bool = True) -> int:
    """Composes the configuration of the command line and gives what it describes to `job`, in a sweep once a cell.

    Args:
        runs: whether the cells of a sweep are runs, so that they have a plan.

    Returns:
        the exit status: 0, or the status of a mistake that was printed on standard error.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors come here, to be printed in one line
    begun: list[DictConfig] = []
    raised: list[OSError | ValueError] = []

    def guarded(config: DictConfig) -> None:
        begun.append(config)
        try:
            identity = _identified(config)
            if config.plan and not runs:
                raise ValueError("plan=true lists runs, and this command starts none: remove it")
            job(identity)
            raise_if_stopped()
        except (OSError, ValueError) as error:  # Hydra would print a line of its own about it
            raised.append(error)

    if (text := _answer(sys.argv[1:], sys.modules["__main__"].__doc__ or "")) is not None:
        return _print(text)
    catch_signals()
    Sweep.runs, typed = runs, AS_TYPED if "field=file" in sys.argv else {}
    program = hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")(guarded)
    try:
        sys.argv[1:] = [text_as_typed(argument) for argument in with_network(options_first(sys.argv[1:]))]
        register(*own_folders(sys.argv[1:]))
        register_slurm()
        with mode_of_options(sys.argv[1:]):
            _call(program)
        if raised:
            raise raised[0]
    except KeyboardInterrupt as error:
        text = stopped_by(error)
        none = Sweep.plan is None and not text.startswith("killed")  # as a run says that has left a record
        return _tell(f"{text}; nothing was run" if none else text, INTERRUPTED)
    except (HydraException, OmegaConfBaseException, ValueError) as error:  # one of Hydra's is an OSError too
        leave_server()
        text = _with_file(_explain(error))
        for key, short in typed.items():
            text = text.replace(key, short)
        return _tell(text, USAGE)
    except BrokenPipeError:  # `| head` has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return FAILED
    except OSError as error:
        return _tell(unwritten(error))
    except Exception as error:
        what = " ".join(str(error).split())
        if Sweep.plan is not None:  # a cluster that is not there, a worker that is lost
            return _tell(f"the launcher stopped: {what}; the same command goes on")
        if begun:
            raise
        return _tell(f"cannot compose {' '.join(sys.argv[1:])!r}: {what}", USAGE)  # Hydra, at a value of an odd type
    finally:
        forget_signals()
    return 0


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


def options_first(arguments: list[str]) -> list[str]:
    """The arguments with options, such as -m, before all `key=value`, as Hydra wants them.

    Raises:
        ValueError: for an unknown option.
    """
    parser = get_args_parser()
    given, unknown = parser.parse_known_intermixed_args(arguments)
    if unknown:
        known = sorted(name for action in parser._actions for name in action.option_strings)
        key = unknown[0].lstrip("-").partition("=")[0]
        if key and (names(key) or type_of(key) is not None):
            raise ValueError(f"unknown option {unknown[0]!r}: settings have no dashes, write {key}=VALUE")
        raise ValueError(f"unknown option {unknown[0]!r}{nearest(unknown[0], known)}")
    options = list(arguments)
    for override in given.overrides:
        options.remove(override)
    return [*options, *given.overrides]


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


def own_folders(arguments: list[str]) -> list[Path]:
    """The folder of configurations that a command adds, which may have tables."""
    folder = get_args_parser().parse_known_args(arguments)[0].config_dir
    return [Path(folder)] if folder else []


def _identified(config: DictConfig) -> Identity:
    """The run that a configuration describes; raises ValueError for what needs no torch to be found invalid."""
    register_resolvers()  # again, since a launcher's worker has not read the command line
    hydra = HydraConfig.get()
    if (asked := os.environ.get(KERNELS)) not in (None, "", "torch", "compiled"):
        raise ValueError(f"{KERNELS} must be torch or compiled, not {asked!r}: unset it for compiled")
    if Path(hydra.runtime.cwd) != Path.cwd():  # of such a worker
        config.results_dir = str(Path(hydra.runtime.cwd) / config.results_dir)
    return identify(resolved(config, hydra.runtime), hydra.runtime, hydra.overrides.task)


def _call(program: Callable[[], None]) -> None:
    """Calls it; where a sweep was refused, raises why, and KeyboardInterrupt also where that became another error."""
    try:
        program()
        raise_if_stopped()  # also where a library swallowed it
    except Shown:
        return
    except (Refused, Exception) as error:
        if stopped := stopped_by(error):
            raise KeyboardInterrupt(stopped) from error
        if isinstance(error, Refused):
            raise error.why from error.why.__cause__
        raise


@contextmanager
def mode_of_options(arguments: list[str]) -> Iterator[None]:
    """Within it, -m alone decides whether a command is a sweep, unless the command or a folder of it may set that.

    Else Hydra composes the configuration once more to read `hydra.mode`, which none of ours sets.
    """
    asked = Hydra.get_mode
    if not own_folders(arguments) and not any("hydra.mode" in argument for argument in arguments):
        Hydra.get_mode = lambda *_, **__: None
    try:
        yield
    finally:
        Hydra.get_mode = asked


def _tell(message: str, code: int = FAILED) -> int:
    if any(argument.replace(" ", "").lower() == "verbose=true" for argument in sys.argv[1:]):
        traceback.print_exc()
    print(f"error: {message}", file=sys.stderr)
    return code


def _explain(error: Exception) -> str:
    """One line that names what is wrong and, for an unknown name, the nearest known one."""
    if isinstance(error, OverrideParseException):
        return _unreadable(error.override)
    chain = [error, error.__cause__, error.__context__]
    for cause in chain:
        if isinstance(cause, MissingConfigException) and cause.missing_cfg_file:
            missing = str(cause.missing_cfg_file)
            nested = missing.startswith("hydra/") or "/" not in missing
            group, _, name = missing.rpartition("/") if nested else missing.partition("/")
            if group == "hydra/launcher" and (extra := EXTRAS.get(name.split("_")[0])):
                return f"this launcher needs a plugin: {install(extra)}"
            what = f"unknown {group} {name!r}" if group else f"unknown configuration {name!r}"
            options = cause.options or names(group)  # Hydra has none for what a row builds on
            known = [option for option in options if not option.startswith("_")]  # others build on these
            own = f"; a mesh of your own is dataset=mesh dataset.path={name}" if group == "dataset" else ""
            return what + nearest(name, known) + (own if "/" in name or "." in name else "")
    message = " ".join(str(error).split())
    if found := re.search(r"In '(experiment|method)/([^']+)'.* full_key: \1\b|@(experiment|method)\.", message):
        file = f"{found[1]}/{found[2]}.yaml" if found[1] else f"a YAML of {found[3]}"
        return f"{file} must begin with the line # @package _global_: its keys are those of the top level"
    if found := re.search(r"Key '([^']+)' not in", message):  # of a row or a file
        return f"unknown key {found[1]!r}" + nearest(found[1], _known_keys())
    if found := re.match(r"Ambiguous value for argument '(.*?)=(.*)' 1\.", message):
        key, values = found.groups()
        if names(key):
            return f"{key} has several values: add -m for a run of each"
        quoted = f"or quote it where it is one value: '{key}=\"{values}\"'"
        return f"{key} has several values: add -m for a run of each, write {key}=[{values}] for a list, {quoted}"
    if isinstance(error, ConfigCompositionException):
        if found := re.search(r"Could not override '([^']+)'", message):
            if names(found[1]):
                return f"{found[1]} is not chosen by default: write +{found[1]}=NAME, with a plus"
            if found[1].startswith("renderer.") and "renderer=custom" in sys.argv:
                return f"unknown key {found[1]!r}: an argument of your class is set by +{found[1]}=VALUE, with a plus"
            return f"unknown key {found[1]!r}" + nearest(found[1], _known_keys())
        if found := re.search(r"Could not find '([^']+)/([^'/]+)'", message):
            return f"unknown {found[1]} {found[2]!r}" + nearest(found[2], _choices(found[1]))
        if found := re.match(r"Error merging override \+*([\w.]+)=(.*)$", message):
            return wrong_type(found[1], found[2], type_of(found[1]))
        if error.__cause__ is not None:
            detail = " ".join(str(error.__cause__).split(" full_key")[0].split())
            return f"{message}: {detail}" if detail not in message else message
    return message


def _with_file(message: str) -> str:
    """A message on a mistyped key, with the file of the user's folder that has it; other messages as they are."""
    if (found := re.search(r"(?:has no|unknown) key '([^']+)'", message)) is None:
        return message
    key = re.compile(rf"\b{re.escape(found[1])}\b[\w.]*\s*:")
    files = [path for folder in own_folders(sys.argv[1:]) for path in sorted(folder.rglob("*.yaml"))]
    return message + next((f" It is in {path}" for path in files if key.search(path.read_text("utf-8", "replace"))), "")


def _unreadable(override: str) -> str:
    """One line on an override that Hydra cannot read."""
    for group in GROUPS:
        if override in _choices(group):
            plus = "+" if group in ("method", "experiment") else ""
            return f"{override!r} is no setting: write {plus}{group}={override}"
    if COMMA.search(override):
        return f"{override!r} has a comma without a value beside it: write key=a,b"
    return f"cannot read {override!r}: write key=value, and quote a value with special characters as 'key=\"value\"'"


def _choices(group: str) -> list[str]:
    return [name for name in names(group) if not name.startswith("_")]


def _known_keys() -> list[str]:
    """Every dotted key of the configuration with the choices of the command line, as far as these are known."""
    chosen = [a for a in sys.argv[1:] if (found := CHOICE.fullmatch(a)) and found[2] in _choices(found[1])]
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return list(_dotted(compose("config", chosen)))


def _dotted(node: DictConfig, prefix: str = "") -> list[str]:
    keys = []
    for key in node:
        name = f"{prefix}{key}"
        keys.append(name)
        child = node._get_node(key)
        if OmegaConf.is_dict(child) and not child._is_missing() and not child._is_none():
            keys += _dotted(child, f"{name}.")
    return keys
