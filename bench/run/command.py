"""The command line: Hydra underneath, with one clear line for every mistake."""

import os
import re
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

import hydra
from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bench.config import CONF, check_label, check_names, register
from bench.hints import nearest
from bench.run.check import check_apart
from bench.run.plan import Shown
from bench.run.process import catch_signals, forget_signals, raise_if_stopped, stopped_by
from bench.run.sweep import Refused, Sweep
from bench.tables import names
from bench.targets import check_targets
from datasets.extras import install

COMMA = re.compile(r"[=,]\s*,|,\s*$")  # without a value beside it
CHOICE = re.compile(r"(\w+)=(\w+)")  # of one YAML of a group
USAGE = 2  # exit status of a command line that asks for what there is not
FAILED = 1
EXTRAS = {"joblib": "joblib", "submitit": "submitit", "ray": "ray"}  # by the beginning of a launcher's name
INTERRUPTED = 130  # 128 + SIGINT, as shells have it


def command_line(job: Callable[[DictConfig], None], *, runs: bool = True) -> int:
    """Composes the configuration of the command line and gives it to `job`, once, or in a sweep once a cell.

    Args:
        job: what the command does; where its cells are no runs, `plan=true` is its to read.
        runs: whether the cells of a sweep are runs, so that they have a plan.

    Returns:
        the exit status: 0, or the status of a mistake that was told on standard error.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors come here, to be told in one line
    begun: list[DictConfig] = []
    raised: list[OSError | ValueError] = []

    def guarded(config: DictConfig) -> None:
        begun.append(config)
        try:
            _check(config)
            job(config)
            raise_if_stopped()
        except (OSError, ValueError) as error:  # Hydra would print a line of its own about it
            raised.append(error)

    catch_signals()
    Sweep.other = None if runs else job
    program = hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")(guarded)
    try:
        sys.argv[1:] = options_first(sys.argv[1:])
        register(*own_folders(sys.argv[1:]))
        _call(program)
        if raised:
            raise raised[0]
    except KeyboardInterrupt as error:
        before = "" if begun or Sweep.plan is not None else "; nothing was run"
        return _tell(stopped_by(error) + before, INTERRUPTED)
    except OverrideParseException as error:
        return _tell(_unreadable(error.override), USAGE)
    except (HydraException, OmegaConfBaseException, ValueError) as error:  # one of Hydra's is an OSError too
        return _tell(_explain(error), USAGE)
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


def options_first(arguments: list[str]) -> list[str]:
    """The arguments with options, such as -m, before all `key=value`, as Hydra wants them.

    Raises:
        ValueError: for an option that there is not.
    """
    known = {name: action for action in get_args_parser()._actions for name in action.option_strings}
    options, others, rest = [], [], list(arguments)
    while rest:
        word = rest.pop(0)
        if not word.startswith("-"):
            others.append(word)
            continue
        action = known.get(word.partition("=")[0])
        if action is None:
            raise ValueError(f"unknown option {word!r}{nearest(word, sorted(known))}")
        options.append(word)
        given = rest and (action.nargs is None or (action.nargs == "?" and rest[0] in (action.choices or ())))
        if given and "=" not in word:
            options.append(rest.pop(0))
    return [*options, *others]


def own_folders(arguments: list[str]) -> list[Path]:
    """The folder of configurations that a command adds, which may have tables."""
    folder = get_args_parser().parse_known_args(arguments)[0].config_dir
    return [Path(folder)] if folder else []


def unwritten(error: OSError) -> str:
    """One line on what could not be written, and what to do."""
    path = Path(error.filename) if error.filename else None
    file = next((above for above in path.parents if above.is_file()), path) if path else None
    where = f" ({file})" if file else ""
    return f"{error.strerror or error}{where}: set results_dir to a folder you can write, or free space"


def _check(config: DictConfig) -> None:
    """Raises ValueError for what can be told of a configuration without torch."""
    check_names(config)
    chosen = HydraConfig.get()
    check_label(config, chosen.overrides.task)
    check_targets(config, chosen.overrides.task, chosen.runtime.choices.get("renderer", ""))
    check_apart(config)


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
            raise error.why from None
        raise


def _tell(message: str, code: int = FAILED) -> int:
    if any(argument.replace(" ", "").lower() == "verbose=true" for argument in sys.argv[1:]):
        traceback.print_exc()
    print(f"error: {message}", file=sys.stderr)
    return code


def _explain(error: Exception) -> str:
    """One line that names what is wrong and, for an unknown name, the nearest known one."""
    chain = [error, error.__cause__, error.__context__]
    for cause in chain:
        if isinstance(cause, MissingConfigException) and cause.missing_cfg_file:
            missing = str(cause.missing_cfg_file)
            nested = missing.startswith("hydra/") or "/" not in missing
            group, _, name = missing.rpartition("/") if nested else missing.partition("/")
            if group == "hydra/launcher" and (extra := EXTRAS.get(name.split("_")[0])):
                return f"hydra/launcher={name} needs a plugin: {install(extra)}"
            what = f"unknown {group} {name!r}" if group else f"unknown configuration {name!r}"
            known = [option for option in cause.options or [] if not option.startswith("_")]  # others build on these
            own = f"; a mesh of your own is dataset=mesh dataset.path={name}" if group == "dataset" else ""
            return what + nearest(name, known) + (own if "/" in name or "." in name else "")
    message = " ".join(str(error).split())
    if isinstance(error, ConfigCompositionException):
        if found := re.search(r"Could not override '([^']+)'", message):
            if names(found[1]):
                return f"{found[1]} is not chosen by default: write +{found[1]}=NAME, with a plus"
            return f"unknown key {found[1]!r}" + nearest(found[1], _known_keys())
        if found := re.search(r"Could not find '([^']+)/([^'/]+)'", message):
            return f"unknown {found[1]} {found[2]!r}" + nearest(found[2], _choices(found[1]))
        if error.__cause__ is not None:
            detail = " ".join(str(error.__cause__).split(" full_key")[0].split())
            return f"{message}: {detail}" if detail not in message else message
    return message


def _unreadable(override: str) -> str:
    """One line on an override that Hydra cannot read."""
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
