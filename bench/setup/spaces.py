"""Search spaces: the settings of a method that may be tuned, choices of `method/space`.

`${drawn:DIMENSION,LOW,HIGH}` is the coordinate, in that dimension, of the Sobol point with the number `draw`. An
experiment sweeps over all spaces except the named ones by `+method: ${spaces:NAME,...}`.
"""

from functools import cache

from bench.tables import SPACE, group_choices

SOBOL_DRAWS, SOBOL_DIMENSIONS = 64, 8
SOBOL_SEED = 1610  # with it, no two of the first five dimensions correlate by 0.1 over the first 16 points


def spaces(*without: str) -> str:
    """The search spaces of all methods that have one, as a list for a sweep.

    Args:
        without: names of methods that are left out.

    Raises:
        ValueError: if such a method has no search space.
    """
    choices = group_choices(SPACE)
    if unknown := {*without} - {*choices}:
        raise ValueError(f"${{spaces:...}} leaves out {', '.join(sorted(unknown))}: not in method/space")
    return ",".join(f"space/{name}" for name in sorted(choices) if name not in without)


def drawn_value(draw: int | None, dimension: int, low: float, high: float) -> float | int:
    """The value of a draw in a logarithmic range: an integer if both ends are, else with 3 digits.

    Raises:
        ValueError: if the draw is missing or out of range, or the range or dimension is invalid.
    """
    if draw is None or not 0 <= draw < SOBOL_DRAWS:
        raise ValueError(f"a method of method/space needs draw=0 to draw={SOBOL_DRAWS - 1}, found {draw}")
    if not (0 < low < high and 0 <= dimension < SOBOL_DIMENSIONS):
        raise ValueError(
            f"${{drawn:{dimension},{low},{high}}} must have a dimension from 0 to {SOBOL_DIMENSIONS - 1} "
            "and ends above 0"
        )
    value = low * (high / low) ** sobol_points()[draw][dimension]
    return round(value) if isinstance(low, int) and isinstance(high, int) else float(f"{value:.3g}")


@cache
def sobol_points() -> list[list[float]]:
    """Points [SOBOL_DRAWS, SOBOL_DIMENSIONS] of a scrambled Sobol sequence in the unit cube, shared by all methods."""
    from scipy.stats import qmc  # here, because the import takes a second

    return qmc.Sobol(SOBOL_DIMENSIONS, scramble=True, rng=SOBOL_SEED).random(SOBOL_DRAWS).tolist()
