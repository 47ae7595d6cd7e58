"""Hints at the ends of error messages: the new name of what was renamed, and the nearest known names."""

import re
from difflib import get_close_matches

MANY = 20  # names, beyond which a message leaves variants out
KEY = re.compile(r"\w+(\.\w+)+")  # a dotted key and nothing else
STRATEGIES = {  # of the group `strategy`, whose files are files of `renderer` now
    "aggressive": "dist_aggressive",
    "capped": "dist_capped",
    "coarse_to_fine": "dist_coarse_to_fine",
    "coarse_to_fine_100": "dist_coarse_to_fine_100",
    "dist": "dist",
    "dvr": "dvr_64",
    "dvr_128": "dvr",
    "dvr_official_slope": "dvr_official_slope",
    "dynamic": "dist_dynamic",
    "idr": "idr",
    "naive": "naive_serial",
    "official_clamp": "dist_official_clamp",
    "parallel": "naive_practical_parallel",
    "practical_gradient": "naive_practical",
    "slope_bound": "dist_slope_bound",
    "step_back": "dist_step_back",
    "step_floor": "dist_step_floor",
    "unrolled_parallel": "naive_parallel",
}
SETTINGS = (  # of the group `setting`, likewise; these keep their names
    *("dist", "dist_alpha_1", "dist_alpha_1_2", "dist_alpha_2", "dist_epsilon_5e3", "dist_epsilon_5e4", "dist_k_3"),
    *("dist_one_level", "dist_steps_10", "dist_steps_20", "idr", "idr_epsilon_5e3", "idr_steps_20", "naive"),
    "naive_steps_20",
)
K_OR_N = "renderer.n_gradient_samples (K, of dist and naive) or renderer.n_ray_samples (n, of dvr)"
SIZES = "sizes.smoke, sizes.desk or sizes.paper, which +experiment=NAME has"
RENAMED = {  # what users typed before, a choice as GROUP/NAME or a key, and what to type now
    **{f"strategy/{name}": f"renderer={renderer}" for name, renderer in STRATEGIES.items()},
    "strategy": "renderer=NAME",
    **{f"setting/{name}": f"renderer={name}" for name in SETTINGS},
    "setting/dvr": "renderer=dvr_early_stop",
    **{f"setting/dvr_{n}": f"renderer=dvr_fixed_{n}" for n in (16, 32, 64, 128)},
    "setting/dist_half": "+method=dist_half",
    "setting": "renderer=NAME",
    "trial/completion": "+experiment=speed_completion",
    "trial/rendering": "+experiment=speed_rendering",
    "trial": "+experiment=speed_completion or +experiment=speed_rendering",
    **{f"condition/focal_{name}": f"task.focal={int(name) / 100:g}" for name in ("050", "075", "105")},
    **{f"condition/start_{name}": f"task.start_scale={int(name) / 100:g}" for name in ("000", "050", "200")},
    "condition": "task.focal=1 task.start_scale=1",
    "common": "+experiment=fitted",
    "experiment/speed_accuracy": "+experiment=speed_completion or +experiment=speed_rendering",
    "experiment/fig10": "+experiment=fig10_focal or +experiment=fig10_start",
    "renderer.samples": K_OR_N,
    "task.samples": "renderer.n_gradient_samples",
    **{f"task.{name}": f"task.optimiser.{name}" for name in ("iterations", "learning_rate", "schedule")},
    **{f"task.code_{name}": f"task.code.{name}" for name in ("weight", "average")},
    "scale.limits.seconds": "scale.limits.values",
    "task.limits.seconds": "task.limits.values",
    "ladder.rungs": "models.candidates",
    "ladder": "models",
    **{f"ladder.{name}": f"models.{name}" for name in ("fit", "growth", "views")},
    "task.stress.among": "task.stress.setting alone",
    **{f"scale.{name}": SIZES for name in ("table2", "table3", "fig6", "fig10", "speed_accuracy")},
    **{f"scale.{name}": SIZES for name in ("stability.stresses", "capacity.resolution", "capacity.scenes")},
}


def renamed(name: str, known: list[str] | None = None) -> str:
    """A hint at the end of an error message: the new name of a choice GROUP/NAME or of a key; empty for others.

    With the dotted keys that are `known`, also empty where the new key, or the one that holds it, is not among them.
    """
    outer = [name, name.split("/")[0], *(name.rsplit(".", count)[0] for count in range(1, name.count(".") + 1))]
    new = next((RENAMED[known] for known in outer if known in RENAMED), None)
    holders = [key for key in known or [] if "." in key]
    if new and known and KEY.fullmatch(new) and not any(f"{new}.".startswith(f"{key}.") for key in holders):
        return ""
    return f": it was renamed, write {new}" if new else ""


def nearest(word: str, known: list[str]) -> str:
    """A hint at the end of an error message: the nearest known names, or all of them."""
    last = [name for name in known if "." not in word and name.rsplit(".", 1)[-1] == word]
    folder = [name for name in known if "/" in word and name.startswith(word.rpartition("/")[0] + "/")]
    close = last or [name for name in get_close_matches(word, folder or known, n=3, cutoff=0.5) if name != word]
    if close:
        return f": did you mean {' or '.join(close)}?"
    roots = [name for name in known if not any(name.startswith(f"{other}_") for other in known)]
    shown = roots if len(known) > MANY else known
    return f": it has {', '.join(sorted(shown))}" + (", and variants of these" if len(shown) < len(known) else "")
