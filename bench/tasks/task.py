"""The protocols of a task: `Task` for all, `TakesField` for tasks that accept any field for the unknown shape."""

from typing import ClassVar, Protocol, runtime_checkable

from bench.setup.inputs import RunContext


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
