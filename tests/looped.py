"""One test for many values, where each of them is cheap and all are alike."""

import inspect
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any


def each(names: str, values: Sequence[Any]) -> Callable[[Callable], Callable]:
    """Runs a test with each of the values in turn, as `parametrize` does in as many tests; the failing one is named.

    Args:
        names: of the test's arguments, separated by commas.
        values: of the argument, or tuples of the arguments.
    """
    keys = [name.strip() for name in names.split(",")]

    def decorate(test: Callable) -> Callable:
        signature = inspect.signature(test)
        left = [parameter for name, parameter in signature.parameters.items() if name not in keys]

        @wraps(test)
        def looped(**fixtures: Any) -> None:
            for value in values:
                given = dict(zip(keys, value, strict=True)) if len(keys) > 1 else {keys[0]: value}
                try:
                    test(**fixtures, **given)
                except BaseException as error:
                    error.add_note(f"with {given}")
                    raise

        looped.__signature__ = signature.replace(parameters=left)  # by which pytest knows the fixtures
        return looped

    return decorate
