"""The names of the fields that an unknown shape may have, other than a prior's code."""

import re

from bench.config import AUTO, PRIOR_FIELD
from bench.tables import nearest
from renderers.checks import check_at_least

PRIMITIVES = ("sphere", "ellipsoid", "box", "rounded_box", "superquadric")
# The text after the underscore.
SIZE_PATTERNS = {"union": "[0-9]+", "grid": "[0-9]+", "occupancy": "[0-9]+"}
SIZE_PATTERNS |= {"network": "[0-9]+x[0-9]+", "fourier": "[0-9]+x[0-9]+", "hash": "[0-9]+x[0-9]+"}
EXAMPLES = ("union_3", "network_4x64", "fourier_4x64", "hash_8x10", "grid_32", AUTO, PRIOR_FIELD)
NAME_FORMS = "union_K, network_LAYERSxWIDTH, fourier_LAYERSxWIDTH, hash_LEVELSxLOG2ENTRIES, grid_N, occupancy_WIDTH"
MAX_GRID_SAMPLES = 256  # per axis: 64 MiB of values


def parse_field_name(name: str) -> tuple[str, tuple[int, ...]]:
    """The kind and the sizes of a candidate's name, such as ("network", (4, 64)); a primitive has no size.

    Raises:
        ValueError: no candidate has this name.
    """
    if name in PRIMITIVES:
        return name, ()
    kind, _, size = name.partition("_")
    if kind not in SIZE_PATTERNS or re.fullmatch(SIZE_PATTERNS[kind], size, re.ASCII) is None:
        raise ValueError(
            f"unknown field {name!r}{nearest(name, [*PRIMITIVES, *EXAMPLES])}; or {NAME_FORMS}, in numbers"
        )
    sizes = tuple(map(int, size.split("x")))
    if kind == "union":
        check_at_least("K of union_K", sizes[0], 2, "union_2 is the smallest")
    if kind in ("network", "fourier"):
        remedy = {"network": "network_1x16 is small", "fourier": "fourier_4x64 suits one shape"}[kind]
        check_at_least(f"{kind} layers", sizes[0], 1, remedy)
        check_at_least(f"{kind} width", sizes[1], 4, remedy)
    if kind == "hash" and not (2 <= sizes[0] <= 16 and 4 <= sizes[1] <= 19):
        raise ValueError(f"{name}: a hash grid has 2 to 16 levels, and 2^4 to 2^19 entries in each: hash_8x10")
    if kind == "grid" and not 8 <= sizes[0] <= MAX_GRID_SAMPLES:
        raise ValueError(f"N of grid_N must lie between 8 and {MAX_GRID_SAMPLES}, not {sizes[0]}: grid_32")
    return kind, sizes
