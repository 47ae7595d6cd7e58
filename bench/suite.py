"""`python -m bench.suite`: the suite, every renderer on the same problems; finished runs are reused.

    python -m bench.suite                                       the quick size, all renderers that the suite lists
    python -m bench.suite renderer=newton                       one renderer, with the shipped results
    python -m bench.suite renderer=custom renderer._target_=mypkg.Mine label=Mine       your own
    python -m bench.suite suite=core hydra/launcher=slurm       the large size, on a cluster
    python -m bench.suite set=pose,complete                     some sets of problems
    python -m bench.suite budget=10                             at 10 units of cost; 1,10 is both
    python -m bench.suite setting=tuned renderer=newton         with its own learning rate and rays, as a second row
    python -m bench.suite setting=candidates renderer=newton    chooses these: runs the candidates on validation shapes
    python -m bench.suite plan=true                             what would run, and for how long

Any other KEY=VALUE is passed to `python -m bench`.
"""

import re
import sys
from collections import Counter
from collections.abc import Sequence
from itertools import product
from pathlib import Path

from bench.records.format import MISSING, number, plural, seconds
from bench.records.read import read_records
from bench.records.results import RESULTS
from bench.report.suite.attempts import (
    BUDGET_KEY,
    CUSTOM,
    EXPERIMENT_PREFIX,
    FIXED_KEYS,
    NOISE_KEY,
    PROBLEM_SETTINGS,
    SECOND_SUFFIX,
    TUNED_SUFFIX,
    attempts_of,
    gather,
    problems_of,
    read_attempts,
    suite,
    write_attempts,
)
from bench.report.suite.bias import bias_lines
from bench.report.suite.standing import KEY, Standing, units, verified_ranking
from bench.report.suite.tuned import CANDIDATES, STATED, Chosen, chosen_settings, setting_overrides
from bench.report.suite.verdicts import row_alone, undecided
from bench.report.write import paper
from bench.report.write.html import MAX_MESHES, page_lock, write_page
from bench.report.write.table import percent
from bench.runner.command import command_line
from bench.runner.run import run_one
from bench.runner.summary import print_statuses
from bench.runner.sweep import run_sweep
from bench.tables import nearest

PAGE, TUNED_PAGE = "suite", "suite_tuned"  # their file names in the folder `paper`
FINISHED_EXIT_STATUSES = (0, 1)  # the sweep has ended, though runs may have failed
STATED_KEYS_PATTERN = rf"[+~]*(({'|'.join([*FIXED_KEYS, 'sizes', 'scale', 'models', 'effort'])})(\W|$)|dataset\.)"
AXES = (*(key for key, _, _ in PROBLEM_SETTINGS.values()), NOISE_KEY)  # may be typed: some problems, a second start
SETUP_AND_EVALUATION_SECONDS = 2.0  # per run
MAX_PRINTED_PROBLEMS = 6  # with more problems, the errors are not printed one by one
SETTING_VALUES = (STATED, "tuned", CANDIDATES)  # the set's for all renderers; each one's own; those it is chosen from
VALIDATION = "validation"
VALIDATION_SHAPES = [f"split={VALIDATION}", "index=0,1"]


def main(arguments: Sequence[str]) -> int:
    """Makes the missing runs of each set, writes the suite's page and prints the standing; returns the exit status."""
    if {"-h", "--help"} & {*arguments}:
        print(__doc__)
        return 0
    try:
        options, overrides = parse_arguments(arguments)
        results_dir = Path(dict(text.split("=", 1) for text in overrides).get("results_dir", RESULTS))
        _make_folder(results_dir)
        if options["setting"] != CANDIDATES:
            print(_expected_runtime(options, _renderers(overrides)))
        for title, keys in _sweeps(options, overrides, results_dir):
            print(title, flush=True)
            sys.argv[1:] = ["-m", *keys]  # like `python -m bench -m`, in this process, without a page
            code = command_line(run_one, lambda composer, config: run_sweep(composer, config, print_statuses))
            if code not in FINISHED_EXIT_STATUSES:
                return code
        return 0 if "plan=true" in map(str.lower, overrides) else print_standing(results_dir, options["setting"])
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _make_folder(results_dir: Path) -> None:
    try:
        results_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = f"results_dir={results_dir} cannot be made ({error.strerror})"
        raise ValueError(f"{reason}: name a folder that you may write to") from error


def parse_arguments(arguments: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """The options of this command, with defaults, and the overrides that it passes on; or ValueError."""
    options, overrides = {"suite": "quick", "set": ",".join(suite().errors), "setting": STATED}, list[str]()
    budgets = sorted({f"{budget:g}" for *_, budget in problems_of("core")})
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key in ("suite", "set", "setting", "budget"):
            options[key] = value
        elif re.match(STATED_KEYS_PATTERN, key) and key not in AXES:
            raise ValueError(f"{key} is stated by the suite, so that all rows have the same: leave it out")
        elif key == "label" and (value in shipped_rows() or value.endswith((TUNED_SUFFIX, SECOND_SUFFIX))):
            ending = TUNED_SUFFIX if value.endswith(TUNED_SUFFIX) else SECOND_SUFFIX
            reason = "is the name of a shipped row" if value in shipped_rows() else f"ends in '{ending}'"
            raise ValueError(f"label={value} {reason}: type another one")
        elif "=" in argument:
            overrides.append(argument)
        else:
            raise ValueError(f"{argument!r} is no KEY=VALUE: python -m bench.suite --help has examples")
    noise = [text.partition("=")[2] for text in overrides if text.startswith(NOISE_KEY)]
    if noise and (options["setting"] != STATED or noise != ["1e-6"]):
        raise ValueError(f"a second start is {NOISE_KEY}=1e-6, with setting=stated")
    options.setdefault("budget", ",".join(budgets) if options["suite"] == "core" else budgets[0])
    allowed_words = {"suite": suite().sizes, "set": suite().errors, "setting": SETTING_VALUES, "budget": budgets}
    for key, allowed in allowed_words.items():
        for word in options[key].split(",") if key in ("set", "budget") else [options[key]]:
            if word not in allowed:
                raise ValueError(f"unknown {key} {word!r}{nearest(word, [*allowed])}")
    return options, overrides


def _renderers(overrides: list[str]) -> list[str]:
    return [name for text in overrides if text.startswith("renderer=") for name in text[9:].split(",")]


def _expected_runtime(options: dict[str, str], presets: list[str]) -> str:
    """The number of runs of one renderer, and their time for the fastest and slowest of these or all shipped rows."""
    shipped = [attempt for attempt in read_attempts(paper.SHIPPED)[0] if not attempt.second_start]
    shipped = [attempt for attempt in shipped if attempt.preset in presets] or shipped
    problems = {key[:2] for key in problems_of(options["suite"]) if key[0] in options["set"].split(",")}
    keys = [(*key, float(budget)) for key in problems for budget in options["budget"].split(",")]
    spent, costs = Counter[tuple[str, str]](), Counter[tuple[str, str]]()
    for attempt in shipped:
        if attempt.ok and attempt.seconds is not None and not attempt.tuned:
            row_and_set = attempt.row, attempt.set
            spent[row_and_set] += attempt.seconds * (1 - (attempt.waited or 0))  # without the wait for a processor
            costs[row_and_set] += attempt.budget
    sums = {
        row: sum(
            SETUP_AND_EVALUATION_SECONDS + spent[row, name] / costs[row, name] * budget for name, _, budget in keys
        )
        for row in dict.fromkeys(row for row, _ in costs)
        if all(costs[row, name] for name, *_ in keys)
    }
    runs = f"{plural(len(keys), 'run')} of each renderer"
    if not sums:
        return runs
    fastest, slowest = min(sums, key=sums.__getitem__), max(sums, key=sums.__getitem__)
    texts = [f"{seconds(sums[row])} ({row})" for row in dict.fromkeys((fastest, slowest))]
    return f"{runs}; the shipped ones need about {' to '.join(texts)} of one processor"


def shipped_rows() -> set[str]:
    return {attempt.row for attempt in read_attempts(paper.SHIPPED)[0] if not attempt.second_start}


def _sweeps(options: dict[str, str], overrides: list[str], results_dir: Path) -> list[tuple[str, list[str]]]:
    """The title of each sweep and its overrides, one per set and setting; or ValueError without a setting."""
    sets, sweeps = options["set"].split(","), list[tuple[str, list[str]]]()
    size = "quick" if (options["setting"], options["suite"]) == (CANDIDATES, "core") else options["suite"]
    chosen = chosen_settings(paper.SHIPPED, results_dir)[0] if options["setting"] == "tuned" else {}
    for position, name in enumerate(sets, 1):
        title = f"set {position} of {len(sets)}: {name}"
        keys = [f"+experiment={EXPERIMENT_PREFIX}{name}", f"sizes.chosen={suite().sizes[size]}"]
        if options["setting"] == "tuned":
            sweeps += _tuned_sweeps(title, name, keys, options["budget"].split(","), overrides, chosen)
            continue
        budgets = ",".join(_budget(name, budget) for budget in options["budget"].split(","))
        keys += [f"{BUDGET_KEY}={budgets}", *overrides]
        if options["setting"] == STATED:
            sweeps.append((title, keys))
        else:
            keys += VALIDATION_SHAPES
            sweeps += [(f"{title}, {each}", [*keys, *setting_overrides(name, each)]) for each in suite().candidates]
    return sweeps


def _budget(set_name: str, budget: str) -> str:
    return f"{float(budget) * suite().units[set_name]:.1e}"


def _tuned_sweeps(
    title: str, set_name: str, keys: list[str], budgets: list[str], overrides: list[str], chosen: Chosen
) -> list[tuple[str, list[str]]]:
    """The sweeps of the renderers whose setting is not the set's, by budget and setting; others are printed."""
    label = next((text.partition("=")[2].strip("'\"") for text in overrides if text.startswith("label=")), "")
    others = [text for text in overrides if not text.startswith(("renderer=", "label="))]
    text = f"label='{label or '${renderer._label_}'}{TUNED_SUFFIX}'"
    sweeps = list[tuple[str, list[str]]]()
    for budget in budgets:
        renderers = _renderers(overrides) or [name for *key, name in chosen if key == [float(budget), set_name]]
        by_setting = dict[str, list[str]]()
        for name in renderers:
            setting = chosen.get((float(budget), set_name, label if name == CUSTOM and label else name), "")
            by_setting.setdefault(setting, []).append(name)
        if missing := by_setting.pop("", [] if renderers else ["any renderer"]):
            command = f"setting={CANDIDATES} set={set_name} budget={budget}"
            raise ValueError(f"no setting of {', '.join(missing)} was chosen: first run bench.suite {command}")
        if stated := by_setting.pop(STATED, []):
            print(f"{title}, {', '.join(stated)}: the set's setting is the best one, so its runs count")
        for setting, names in by_setting.items():
            more = [f"{BUDGET_KEY}={_budget(set_name, budget)}", f"renderer={','.join(names)}", text]
            sweeps.append((f"{title}, {setting}", [*keys, *more, *setting_overrides(set_name, setting), *others]))
    return sweeps


def print_standing(results_dir: Path, setting: str = STATED) -> int:
    """Stores the attempts of a results folder, writes the suite's pages, and prints a line per row."""
    pages = [PAGE] if setting == STATED else [PAGE, TUNED_PAGE]
    with page_lock(results_dir):
        records, unread = read_records(results_dir)
        write_attempts(attempts_of(records, results_dir), results_dir)
        write_attempts(attempts_of(records, results_dir, VALIDATION), results_dir, CANDIDATES)
        written = [path for name in pages for path in paper.write_paper(records, results_dir, only=name)]
        index = write_page(records, unread, results_dir, MAX_MESHES)
    gathered = gather(paper.SHIPPED, results_dir)
    for problem in gathered.problems:
        print(f"not read: {problem}", file=sys.stderr)
    local_rows, standing = {attempt.row for attempt in gathered.local}, Standing(gathered)
    print(f"{plural(len(gathered.local), 'run')} of {results_dir}, in rows with a star; the others are shipped.")
    _print_rows(standing, local_rows)
    if standing.complete["problem"].nunique() <= MAX_PRINTED_PROBLEMS:
        _print_errors(standing, local_rows)
    runs = standing.reached[~standing.reached["tuned"]]
    for line in (line for row in sorted(local_rows) for line in bias_lines(runs, row)):
        print(line)
    print(*(path.with_suffix(".png") for path in written if path.with_suffix(".png").is_file()), index, sep="\n")
    return 0


def _print_rows(standing: Standing, local: set[str]) -> None:
    available = plural(len(standing.everything[KEY].drop_duplicates()), "problem")
    compared = plural(len(standing.complete[KEY].drop_duplicates()), "problem")
    print(f"progress on the {compared} that all rows have, of {available} with results; with possible ranks:")
    titles = "".join(f"{f'at {units(budget)}':<16}" for budget in standing.budgets)
    print(f"{'renderer':<28} {titles}failed runs")
    for row in standing.rows:
        cells = [
            f"{percent(ranked.progress[row]):>5} ({ranked.rank(row)})" if row in ranked.progress else f"{MISSING:>5}"
            for ranked in standing.rankings.values()
        ]
        failed = (~standing.complete.loc[standing.complete["row"] == row, "ok"]).sum()
        print(f"{row + (' *' if row in local else ''):<28} {''.join(f'{cell:<16}' for cell in cells)}{failed:>11}")
    most_scenes = len({problem.partition(",")[0] for _, problem, _ in problems_of("core")})
    for budget, ranked in standing.rankings.items():
        if ranked.pairs and not ranked.decidable:
            more = f" suite=core has {most_scenes} scenes." if ranked.scenes < most_scenes else ""
            print(f"{undecided(ranked, f'At {units(budget)}')}{more}")
    for (budget, runs), row in product(standing.complete.groupby("budget"), sorted(local)):
        if row in {*runs["row"]} and runs["row"].nunique() > 1:
            print(row_alone(verified_ranking(runs, row), row, f"At {units(budget)}"))
    for (budget, row), sets in standing.cannot_run.items():
        print(f"{row} cannot run in {sets} at {units(budget)}: it pays for too few iterations.")
    for row, count in standing.other_settings.items():
        print(f"{row}: {plural(count, 'run')} with other settings than the set's, not compared.")
    for (budget, row), missing in standing.lacking.items():
        lacks = f"{row} lacks {plural(missing, 'problem')} at {units(budget)}"
        print(f"{lacks}, so it is not compared there: run all sets with budget={budget:g}.")
    versions = standing.complete[standing.complete["preset"] == CUSTOM].groupby(["row", "set"])["code"]
    versions = versions.nunique().groupby("row").max()
    for row, count in versions[versions > 1].items():
        print(f"{row} has runs of {count} versions of the code: run all sets again.")


def _print_errors(standing: Standing, local_rows: set[str]) -> None:
    best_errors = standing.complete.groupby(KEY)["final"].min()
    for run in standing.reached[standing.reached["row"].isin(local_rows)].itertuples():
        errors = f"initial error {number(run.initial)}, final error {number(run.final)}"
        best_error = f"best renderer {number(best_errors.get((run.set, run.problem, run.budget)))}"
        print(f"{run.row}, {run.set}, {run.problem}: {errors}; {best_error}, best possible {number(run.reference)}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
