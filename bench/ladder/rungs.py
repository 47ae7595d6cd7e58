"""The names of rungs, as `task.ladder` and `field` have them: sphere, union_3, network_4x64, grid_32."""

import re
from collections.abc import Callable

from bench.config import nearest
from bench.ladder.analytic import PARTS, OnePart, UnionOf
from bench.ladder.learned import NarrowBand, Network
from bench.ladder.model import Rung

SIZED: dict[str, Callable[..., Rung]] = {"union": UnionOf, "network": Network, "grid": NarrowBand}
EXAMPLES = ("union_3", "network_4x64", "grid_32", "auto", "prior")
FORMS = "union_K, network_LAYERSxWIDTH, grid_N"
PAPERS = Network(8, 512)  # DeepSDF's, which DIST takes, without a code


def rung(name: str) -> Rung:
    """The rung of a name.

    Raises:
        ValueError: where there is none.
    """
    if name in PARTS:
        return OnePart(name)
    kind, _, size = name.partition("_")
    in_form = re.fullmatch("[0-9]+x[0-9]+" if kind == "network" else "[0-9]+", size, re.ASCII)
    if kind not in SIZED or in_form is None:
        known = [*PARTS, *EXAMPLES]
        raise ValueError(f"unknown field {name!r}{nearest(name, known)}; or {FORMS}, in numbers")
    return SIZED[kind](*map(int, size.split("x")))
