"""The names of rungs, as `task.ladder` and `field` have them: sphere, union_3, network_4x64, grid_32."""

from collections.abc import Callable

from bench.config import nearest
from bench.ladder.analytic import PARTS, OnePart, UnionOf
from bench.ladder.learned import NarrowBand, Network
from bench.ladder.model import Rung

SIZED: dict[str, Callable[..., Rung]] = {"union": UnionOf, "network": Network, "grid": NarrowBand}
EXAMPLES = ("union_3", "network_4x64", "grid_32")
PAPERS = Network(8, 512)  # DeepSDF's, which DIST takes, without a code


def rung(name: str) -> Rung:
    """The rung of a name.

    Raises:
        ValueError: where there is none.
    """
    if name in PARTS:
        return OnePart(name)
    kind, _, size = name.partition("_")
    numbers = size.split("x")
    if kind not in SIZED or not all(number.isdigit() for number in numbers) or len(numbers) != 1 + (kind == "network"):
        known = [*PARTS, *EXAMPLES]
        raise ValueError(f"unknown field {name!r}{nearest(name, known)}")
    return SIZED[kind](*map(int, numbers))
