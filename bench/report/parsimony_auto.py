"""What `auto` saves: early growth against the papers' network, and the frugal fit against the plain one."""

from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.report import format, style
from bench.report.caption import counted_outcome, joined, omitted, setup
from bench.report.experiments import Experiment
from bench.report.ladder import KINDS
from bench.report.parsimony_runs import NETWORK, factor, scene_runs, spread
from bench.report.parsimony_saving import COSTS, FAILED, NOT_REACHED, REACHED, Saving
from bench.report.tables import Result

TARGET = 2.0  # overhead of early growth, at most
CAPTION = (
    "field=auto tries rungs from the smallest on, as long as the held-out error falls; its costs are of all that it "
    "tried, and its overhead is their seconds over those of the fit that it ended on, about {target:g} at most by "
    "design; judged, with the looks at held-out rays that it decides by and what it takes to begin. Beside it what the "
    "choice among all rungs recommends, which costs the whole ladder; "
    "± is one standard error by the jackknife over views. Beside it what the papers' network (8 layers of 512, without "
    "a code) had spent when a look at it first showed that error, or less than a standard error more. Looks are after "
    "the warm start, 4, 16, 64, … iterations and the end, and cost nothing here; the network begins as the best rung "
    "before it, and what that cost is not counted. “Not reached” had not shown it by the end of its fit, whose whole "
    "cost is in brackets and bounds the ratios, which are the network's costs over auto's; – is where it was not "
    "fitted."
)
FRUGAL = (
    "Frugal: the recommended rung fitted again with renderer.epsilon=auto, renderer.steps=auto and as many rays as the "
    "loss asks for, over its plain fit; errors in half pixels. Precision: the held-out rays of the recommended rung "
    "rendered at auto, over the renderer's own epsilon and steps; hits that only the latter has are lost, that only "
    "the former has gained: with a larger epsilon outlines grow by up to half a pixel. Both fits are judged at the "
    "renderer's own precision. Right: a triangle is hollow where the frugal error is above half a pixel."
)
COLUMNS = [
    *("Scene", "auto ends on", "Error × 1000", "Whole ladder needs", "Its error × 1000", "Half a pixel × 1000"),
    *("Seconds", "FLOPs", "Evaluations", "Overhead", "Overhead, judged"),
    *("Network: seconds", "Network: FLOPs", "Network: evaluations", "Ratio of seconds", "Ratio of FLOPs"),
    *("Frugal: evaluations", "Frugal: seconds", "Error in half pixels: plain, frugal"),
    *("Precision: evaluations saved", "Hits lost", "Hits gained", "Hits"),
]
AUTO, EVALUATIONS, ERROR = ("#111111", "o"), ("#6a3d9a", "D"), ("#cc79a7", "^")  # colour and marker
LABELS = {  # of the papers' network
    REACHED: "papers' network",
    NOT_REACHED: "papers' network, not reached in its fit",
    FAILED: "papers' network, fit failed",
}
_HOLLOW: dict[str, Any] = {"mfc": "none", "mew": 1.1}


def make(experiment: Experiment) -> Result:
    """A row a scene."""
    savings = [Saving(run) for run in scene_runs(experiment)]
    return Result(
        name="parsimony_auto",
        title="What auto saves.",
        caption=joined(
            setup(experiment, network=False),
            CAPTION.format(target=TARGET),
            FRUGAL,
            _held(savings),
            counted_outcome(experiment),
            omitted(experiment),
        ),
        data=pd.DataFrame([_raw(saving) for saving in savings], dtype=object),
        table=pd.DataFrame([_told(saving) for saving in savings], columns=COLUMNS),
        notes=[note for saving in savings for note in _failures(saving)],
        figure=draw(savings),
    )


def _held(savings: list[Saving]) -> str:
    """On how many scenes growth kept to its budget, by either measure."""
    known = [saving.run for saving in savings if saving.run.number("auto.overhead") is not None]
    held = [
        sum((run.number(name) or 0) <= TARGET for run in known) for name in ("auto.overhead", "auto.overhead_judged")
    ]
    return f"The overhead is at most {TARGET:g} on {held[0]} of {len(known)} scenes; judged, on {held[1]}."


@style.styled
def draw(savings: list[Saving]) -> Figure:
    """Left, operations of auto and of the network to the same error; right, the frugal fit over the plain one."""
    figure = Figure(figsize=(style.WIDTH, 0.24 * len(savings) + 1.5), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.25, 1))
    for place, saving in enumerate(savings):
        if saving.run.ok:
            _operations(left, saving, place)
            _frugality(right, saving, place)
        else:
            _note(left, place, saving.run.status)
    reach = [x for s in savings for x in (s.run.number("auto.flops"), s.network["flops"]) if x]
    style.log_axis(left, "x", reach)
    style.log_axis(right, "x", [x for s in savings for name in ("evaluations", "error") if (x := s.frugal(name))])
    left.margins(x=0.1)
    right.axvline(1, color="#777777", lw=0.9)
    left.set(xlabel="FLOPs to the error of field=auto", ylim=(len(savings) - 0.5, -0.5))
    right.set(xlabel="frugal fit over plain fit")
    left.set_yticks(range(len(savings)), [saving.run.name for saving in savings])
    figure.legend(*_legend(left), loc="outside lower left", ncols=2)
    figure.legend(*_legend(right), loc="outside lower right")
    return figure


def _legend(axis: Axes) -> tuple[list[Any], list[str]]:
    """Each label once, in alphabetical order."""
    named = style.labelled(axis)
    return [named[label] for label in sorted(named)], sorted(named)


def _operations(axis: Axes, saving: Saving, place: int) -> None:
    auto, network = saving.run.number("auto.flops"), saving.network["flops"]
    if not saving.state or auto is None:
        return _note(axis, place, f"field=auto failed: {saving.failure('auto')}")
    _, colour, marker = KINDS["network"]
    if network is None:
        _note(axis, place, "network not fitted")
    else:
        axis.plot([auto, network], [place, place], color="#bbbbbb", lw=1, zorder=1)
        label = LABELS[saving.state]
        how = {} if saving.state == REACHED else _HOLLOW
        axis.plot(
            network, place, marker if saving.state != FAILED else "x", color=colour, ls="none", label=label, **how
        )
    if saving.state == NOT_REACHED:
        axis.annotate("", (network, place), (14, 0), textcoords="offset points", arrowprops=_arrow(colour))
    axis.plot(auto, place, AUTO[1], color=AUTO[0], ls="none", label="field=auto, all that it tried")
    return None


def _frugality(axis: Axes, saving: Saving, place: int) -> None:
    evaluations, error = saving.frugal("evaluations"), saving.frugal("error")
    if evaluations is None or error is None:
        return _note(axis, place, f"frugal fit failed: {saving.failure('frugal')}")
    axis.plot([evaluations, error], [place, place], color="#bbbbbb", lw=1, zorder=1)
    axis.plot(evaluations, place, EVALUATIONS[1], color=EVALUATIONS[0], ls="none", label="evaluations")
    above = (saving.errors[1] or 0) > 1
    label = f"error, {'above' if above else 'under'} half a pixel"
    axis.plot(error, place, ERROR[1], color=ERROR[0], ls="none", ms=5, label=label, **(_HOLLOW if above else {}))
    return None


def _note(axis: Axes, place: int, text: str) -> None:
    """Words above a scene's line, clear of its markers."""
    how = {"xycoords": axis.get_yaxis_transform(), "textcoords": "offset points", "ha": "right", "va": "bottom"}
    axis.annotate(text, (0.99, place), (0, 4), fontsize=6, color="#666666", **how)


def _arrow(colour: str) -> dict[str, Any]:
    return {"arrowstyle": "<-", "color": colour, "lw": 0.9, "shrinkA": 0, "shrinkB": 3}


def _told(saving: Saving) -> list[str]:
    run, missing = saving.run, format.MISSING
    if not run.ok:
        return [run.name, run.status, *[missing] * (len(COLUMNS) - 2)]
    beyond = saving.state == NOT_REACHED
    ends = run.word("auto.field") or missing
    told = (format.seconds, format.count, format.count)
    plain, frugal = saving.errors
    saved = saving.precision
    return [
        run.name,
        ends.replace("_", " "),
        spread(run.number("auto.error"), run.number("auto.standard_error")),
        (run.word("recommended_field") or missing).replace("_", " "),
        *(format.number(run.number(name), 1000) for name in ("recommended_error", "footprint")),
        *(tell(run.number(f"auto.{cost}")) for tell, cost in zip(told, COSTS, strict=True)),
        *(format.number(run.number(f"auto.{name}")) for name in ("overhead", "overhead_judged")),
        *(_network(saving, tell(saving.network[cost])) for tell, cost in zip(told, COSTS, strict=True)),
        *(factor(saving.ratio(cost), above=beyond) for cost in ("seconds", "flops")),
        *(factor(saving.frugal(name)) for name in ("evaluations", "seconds")),
        f"{format.number(plain)}, {saving.failure('frugal') or format.number(frugal)}",
        missing if saved is None else f"{100 * saved:.0f} %",
        *(format.count(run.number(f"precision.{name}")) for name in ("lost", "gained", "hits")),
    ]


def _network(saving: Saving, told: str) -> str:
    return f"{saving.state} ({told})" if saving.state in (NOT_REACHED, FAILED) else told


def _failures(saving: Saving) -> list[str]:
    """A line for each of these fits that failed."""
    fits = {"auto": "field=auto", "frugal": "the frugal fit", NETWORK: "the papers' network"}
    known = {told: saving.run.word(f"{name}.failed") for name, told in fits.items()}
    return [f"{saving.run.name}, {told}: {reason}" for told, reason in known.items() if reason]


def _raw(saving: Saving) -> dict[str, Any]:
    run = saving.run
    growth = ("error", "standard_error", *COSTS, "overhead", "overhead_judged")
    frugal = ("error", "standard_error", *COSTS)
    precision = ("evaluations", "evaluations_auto", "hits", "lost", "gained")
    numbers = {"auto": growth, "frugal": frugal, "precision": precision}
    return {
        **run.identity,
        "footprint": run.number("footprint"),
        "auto.field": run.word("auto.field"),
        **{f"{part}.{name}": run.number(f"{part}.{name}") for part, names in numbers.items() for name in names},
        "network": saving.state,
        **{f"network.{cost}": saving.network[cost] for cost in COSTS},
        **{f"ratio.{cost}": saving.ratio(cost) for cost in COSTS},
        "recommended_field": run.word("recommended_field"),
        "recommended_error": run.number("recommended_error"),
        **{f"frugal_over_plain.{name}": saving.frugal(name) for name in ("evaluations", "seconds", "error")},
        "precision.saved": saving.precision,
    }
