"""`python -m bench.suite`: the suite, every renderer on the same problems; what has been run is not run again.

    python -m bench.suite                                       the quick size, all renderers that the suite lists
    python -m bench.suite renderer=newton                       one, with the shipped results
    python -m bench.suite renderer=custom renderer._target_=mypkg.Mine label=Mine       your own
    python -m bench.suite suite=core hydra/launcher=slurm       the large size, on a cluster
    python -m bench.suite set=pose,complete                     some sets of problems
    python -m bench.suite setting=tuned renderer=newton         at its own setting of conf/tuned.yaml, as a second row
    python -m bench.suite plan=true                             what would run, and for how long

Any other KEY=VALUE is that of `python -m bench`.
"""

import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.records.format import MISSING, number, plural
from bench.records.read import RESULTS, read_records
from bench.report.suite.attempts import (
    BY_ITSELF,
    EXPERIMENT,
    GIVEN,
    STATED,
    TUNED,
    attempts_of,
    gather,
    read_attempts,
    suite,
    write_attempts,
)
from bench.report.suite.standing import BUDGETS, KEY, Standing
from bench.report.write import paper
from bench.report.write.html import MOST_MESHES, page_lock, write_page
from bench.report.write.table import percent
from bench.tables import CONF, METHOD, choice, names, nearest, read_yaml

PAGE = "suite"  # its name in the folder `paper`
GOES_ON = (0, 1)  # exit statuses of a sweep that has ended, though runs may have failed
LABEL = f"label='${{renderer._label_}}{BY_ITSELF}'"
FIXED = rf"[+~]*(({'|'.join([*STATED, 'sizes', 'scale', 'models'])})(\W|$)|dataset\.)"  # keys that are the suite's
FEW_PROBLEMS = 6  # whose errors are printed one by one
SETTINGS = ("stated", "tuned")  # that of the set for all renderers, or the renderer's own


def main(arguments: Sequence[str]) -> int:
    """Runs what is missing of each set, writes the suite's page and prints the standing; gives the exit status."""
    if {"-h", "--help"} & {*arguments}:
        print(__doc__)
        return 0
    try:
        own, passed = parsed(arguments)
        results_dir = Path(dict(text.split("=", 1) for text in passed).get("results_dir", RESULTS))
        for said, keys in _sweeps(own, passed):
            print(said, flush=True)
            if (code := _sweep(keys)) not in GOES_ON:
                return code
        return 0 if "plan=true" in map(str.lower, passed) else show(results_dir)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def parsed(arguments: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """The keys of this command, with their defaults, and what is passed on.

    Raises:
        ValueError: for an unknown size, set or setting, or a key that the suite states.
    """
    own, passed = {"suite": "quick", "set": ",".join(suite().errors), "setting": "stated"}, list[str]()
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key in ("suite", "set", "setting"):
            own[key] = value
        elif re.match(FIXED, key) and key not in [given for given, _ in GIVEN.values()]:
            raise ValueError(f"{key} is stated by the suite, so that all rows have the same: leave it out")
        elif key == "label" and (value in shipped_rows() or value.endswith(BY_ITSELF)):
            raise ValueError(f"label={value} is the name of a shipped row, or ends in '{BY_ITSELF}': type another one")
        elif "=" in argument:
            passed.append(argument)
        else:
            raise ValueError(f"{argument!r} is no KEY=VALUE: python -m bench.suite --help has examples")
    for key, known in (("suite", suite().sizes), ("set", suite().errors), ("setting", SETTINGS)):
        for word in own[key].split(",") if key == "set" else [own[key]]:
            if word not in known:
                raise ValueError(f"unknown {key} {word!r}{nearest(word, [*known])}")
    return own, passed


def shipped_rows() -> set[str]:
    """The names of the rows that are shipped."""
    return {attempt.row for attempt in read_attempts(paper.SHIPPED)[0]}


def _sweeps(own: dict[str, str], passed: list[str]) -> list[tuple[str, list[str]]]:
    """What is said before each sweep, and its keys: a sweep a set; of tuned settings one for each of them.

    Raises:
        ValueError: where there is no tuned setting for any set.
    """
    sets, found = own["set"].split(","), list[tuple[str, list[str]]]()
    renderers = [name for text in passed if text.startswith("renderer=") for name in text[9:].split(",")]
    rest = [text for text in passed if not text.startswith("renderer=")]
    for nth, name in enumerate(sets, 1):
        said = f"set {nth} of {len(sets)}: {name}"
        keys = [f"+experiment={EXPERIMENT}{name}", f"sizes.chosen={suite().sizes[own['suite']]}"]
        if own["setting"] == "stated":
            found.append((said, [*keys, *passed]))
            continue
        tuned = _tuned(name, renderers)
        found += [(f"{said}, {method}", [*keys, *choices, *rest]) for method, choices in tuned.items()]
        if not tuned:
            print(f"{said}: left out, since conf/tuned.yaml has no setting for it")
    if not found:
        of = ", ".join(renderers) or "a renderer"
        raise ValueError(f"conf/tuned.yaml has no setting of {of} for {own['set']}: leave out setting=tuned")
    return found


def _tuned(of_set: str, renderers: list[str]) -> dict[str, list[str]]:
    """The methods with a tuned setting for a set, of these renderers or of all, and what chooses them.

    A tuned setting goes with the loss of the mask that it was tuned with.
    """
    task, found = _chosen(read_yaml(CONF / "experiment" / f"{EXPERIMENT}{of_set}.yaml"))["task"], {}
    for method in (f"{TUNED}{name}" for name in names(f"{METHOD}/tuned")):
        chosen = _chosen(choice(METHOD, method))
        if chosen.get("task") == task and (not renderers or chosen["renderer"] in renderers):
            found[method] = [f"+method={method}", f"silhouette={chosen.get('silhouette', 'own')}", LABEL]
    return found


def _chosen(node: dict[str, Any]) -> dict[str, str]:
    """What an experiment or a method, with what it builds on, chooses of each group."""
    found = dict[str, str]()
    for base in node.get("defaults", ()):
        if isinstance(base, dict):
            found |= {key.removeprefix("override /"): value for key, value in base.items()}
        elif (name := base.removeprefix(f"/{METHOD}/")) in names(METHOD):
            found |= _chosen(choice(METHOD, name))
    return found


def _sweep(keys: list[str]) -> int:
    command = [sys.executable, "-m", "bench", "-m", *keys]
    with subprocess.Popen(command) as sweep:
        try:
            return sweep.wait()
        except KeyboardInterrupt:  # it got one too, and says what has ended
            return sweep.wait()


def show(results_dir: Path) -> int:
    """Keeps the attempts of a results folder, writes the suite's pages, and prints a line per row."""
    with page_lock(results_dir):
        records, unread = read_records(results_dir)
        write_attempts(attempts_of(records, results_dir), results_dir)
        written = paper.write_paper(records, results_dir, only=PAGE)
        index = write_page(records, unread, results_dir, MOST_MESHES)
    gathered = gather(paper.SHIPPED, results_dir)
    for problem in gathered.problems:
        print(f"not read: {problem}", file=sys.stderr)
    mine, standing = {attempt.row for attempt in gathered.local}, Standing(gathered)
    print(f"{plural(len(gathered.local), 'run')} of {results_dir}, in rows with a star; the others are shipped.")
    _print_rows(standing, mine)
    if standing.whole["problem"].nunique() <= FEW_PROBLEMS:
        _print_errors(standing, mine)
    print(*(path.with_suffix(".png") for path in written if path.with_suffix(".png").is_file()), index, sep="\n")
    return 0


def _print_rows(standing: Standing, mine: set[str]) -> None:
    """The progress and the possible ranks of each row at each cost, what its runs cost, and how many failed."""
    every = plural(len(standing.everything[KEY].drop_duplicates()), "problem")
    count = plural(len(standing.whole[KEY].drop_duplicates()), "problem")
    print(f"progress on the {count} that all rows have, of {every} with results; with possible ranks:")
    print(f"{'renderer':<28} {'at 1 x':<14}{'at 10 x':<14}{'at the end':<14} cost, DIST = 1  failed runs")
    for row in standing.rows:
        values = {name: standing.rankings[name].progress[row] for name in BUDGETS}
        shown = {name: MISSING if row in standing.hidden[name] else percent(value) for name, value in values.items()}
        cells = "".join(f"{f'{shown[name]:>5} ({standing.rankings[name].rank(row)})':<14}" for name in BUDGETS)
        failed = (~standing.whole.loc[standing.whole["row"] == row, "ok"]).sum()
        print(f"{row + (' *' if row in mine else ''):<28} {cells} {number(standing.costs[row]):>14}  {failed:>11}")
    for row, missing in standing.lacking.items():
        print(f"{row} lacks {plural(missing, 'problem')}, so it is not compared: run the suite for it without set=.")


def _print_errors(standing: Standing, mine: set[str]) -> None:
    """The errors of one's own runs, where the problems are few."""
    best = standing.whole.groupby(KEY)["final"].min()
    for run in standing.reached[standing.reached["row"].isin(mine)].itertuples():
        errors = f"initial error {number(run.initial)}, final error {number(run.final)}"
        least = f"best renderer {number(best.get((run.set, run.problem, run.seed)))}"
        print(f"{run.row}, {run.set}, {run.problem}: {errors}; {least}, best possible {number(run.reference)}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
