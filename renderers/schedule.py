"""The position of an iteration in schedules."""


class Iteration(int):
    """The index of an iteration, from 0, with another position in schedules: of a loop that a budget ends."""

    position: int

    def __new__(cls, index: int, position: int) -> "Iteration":
        iteration = super().__new__(cls, index)
        iteration.position = position
        return iteration

    def __reduce__(self) -> tuple[type, tuple[int, int]]:
        return Iteration, (int(self), self.position)  # for copies


def schedule_position(iteration: int) -> int:
    """The iteration that schedules use; it differs from the index in a loop that a budget ends."""
    return iteration.position if isinstance(iteration, Iteration) else iteration
