"""Hints at the ends of error messages: the nearest known names."""

from difflib import get_close_matches

MANY = 20  # names, beyond which a message leaves variants out


def nearest(word: str, known: list[str]) -> str:
    """A hint at the end of an error message: the nearest known names, or all of them."""
    last = [name for name in known if "." not in word and name.rsplit(".", 1)[-1] == word]
    folder = [name for name in known if "/" in word and name.startswith(word.rpartition("/")[0] + "/")]
    variants = [name for name in known if name.startswith(f"{word}_")]

    def alike(cutoff: float) -> list[str]:
        return [name for name in get_close_matches(word, folder or known, n=3, cutoff=cutoff) if name != word]

    close = last or alike(0.85) or variants or alike(0.5)
    if close:
        return f": did you mean {' or '.join(close)}?"
    roots = [name for name in known if not any(name.startswith(f"{other}_") for other in known)]
    shown = roots if len(known) > MANY else known
    if not shown:
        return ""
    return f": it has {', '.join(sorted(shown))}" + (", and variants of these" if len(shown) < len(known) else "")
