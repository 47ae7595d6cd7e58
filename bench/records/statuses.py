"""What each status of a run means, and what to do about it: in words, in one place."""

from typing import NamedTuple

from bench.records.record import NOT_RUN, RunStatus


class Said(NamedTuple):
    """What a status means, and what helps; `remedy` is empty where there is nothing to mend."""

    meaning: str
    remedy: str = ""


STATUSES = {
    RunStatus.OK: Said("It ended as planned."),
    RunStatus.NAN: Said(
        "The loss became NaN.",
        "Lower task.optimiser.learning_rate. The curve shows the last iteration with a finite loss.",
    ),
    RunStatus.DIVERGED: Said(
        "The loss rose a hundredfold.",
        "Lower task.optimiser.learning_rate, or the weight of the loss that rises first.",
    ),
    RunStatus.NOT_REACHED: Said(
        "The loss did not fall.",
        "Try more iterations (task.optimiser.iterations), another seed, or a renderer that has the gradient which the "
        "task needs: `task=gradients` compares them.",
    ),
    RunStatus.EMPTY: Said(
        "The field ended without a surface.",
        "Lower task.optimiser.learning_rate, or raise the weight of the loss of the mask. strip.png shows when the "
        "surface was lost.",
    ),
    RunStatus.TIMEOUT: Said(
        "A limit of time, or of field values, was reached.",
        "Raise time_limit=SECONDS (null is none), or make the work smaller: scale=smoke, view.resolution=32.",
    ),
    RunStatus.OOM: Said(
        "A limit of memory was reached.",
        "Raise memory_limit=GIB where the machine has more, or make the work smaller: view.resolution, "
        "evaluation.grid.",
    ),
    RunStatus.CRASHED: Said(
        "An error ended it.",
        "verbose=true shows where the error came from, and isolation=off lets a debugger stop there. log.txt has "
        "all of it.",
    ),
    RunStatus.KILLED: Said(
        "It was stopped from outside, or is still under way.",
        "The same command runs it again.",
    ),
    RunStatus.UNSUPPORTED: Said(
        "The renderer lacks what the task needs.",
        "This is an answer, not an error. The reason says what is lacking; another renderer or setting may have it.",
    ),
    RunStatus.REFUSED: Said(
        "The configuration is invalid.",
        "The reason names the key and what to type instead.",
    ),
    NOT_RUN: Said(
        "A sweep planned it, and it has not been run.",
        "The command of the sweep runs what is missing, and reuses what is there.",
    ),
}
