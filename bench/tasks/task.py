"""The protocols of a task: `Task` for all; `TakesField` where any field will do, `Checks` where not all inputs will."""

from typing import ClassVar, Protocol, runtime_checkable

from bench.setup.inputs import RunContext, RunInputs


@runtime_checkable
class Task(Protocol):
    """A benchmark problem for a renderer and a scene. It names no renderer."""

    def execute(self, run: RunContext) -> None:
        """Executes the task, and fills the run's record and folder.

        Raises:
            Unsupported: where the renderer cannot do what the task or its field needs.
        """
        ...


@runtime_checkable
class TakesField(Protocol):
    """A task that works with any field, as set by `field=`, in place of a prior's code."""

    takes_field: ClassVar[bool]


@runtime_checkable
class Checks(Protocol):
    """A task that not all inputs will do for, which is told before anything slow, and by `plan=true`."""

    def check(self, inputs: RunInputs) -> None:
        """Raises BadInput for inputs that the task cannot use."""
        ...
