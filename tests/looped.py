"""One test for many values that are cheap to test."""

import inspect
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any


def each(names: str, values: Sequence[Any]) -> Callable[[Callable], Callable]:
    """Runs a test with each value in turn, as `parametrize` does in separate tests; a failure names its value.

    Args:
        names: the test's arguments, separated by commas.
        values: the values of the argument, or tuples of values of the arguments.
    """
    keys = [name.strip() for name in names.split(",")]

    def decorate(test: Callable) -> Callable:
        signature = inspect.signature(test)
        left = [parameter for name, parameter in signature.parameters.items() if name not in keys]

        @wraps(test)
        def looped(**fixtures: Any) -> None:
            for value in values:
                arguments = dict(zip(keys, value, strict=True)) if len(keys) > 1 else {keys[0]: value}
                try:
                    test(**fixtures, **arguments)
                except BaseException as error:
                    error.add_note(f"with {arguments}")
                    raise

        looped.__signature__ = signature.replace(parameters=left)  # pytest reads the fixtures from it
        return looped

    return decorate
