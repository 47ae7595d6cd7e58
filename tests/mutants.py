"""Plants mistakes one at a time in a copy of the project, and prints those that no test finds: `make mutants`.

`make mutants ONLY=silhouette` plants those alone whose file or text contains a word.
"""

import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from shutil import copy2

ROOT = Path(__file__).resolve().parents[1]
WORKERS = 2


@dataclass(frozen=True)
class Mutant:
    """A mistake: `old`, which stands once in `file`, becomes `new`; the tests in `tests` should find it."""

    file: str
    old: str
    new: str
    tests: str


M = Mutant
COARSE = "tests/renderers/test_coarse.py"
EVENED = "tests/renderers/test_evened.py"
TRACED = "tests/renderers/test_newton.py tests/renderers/test_coarse.py tests/renderers/test_warm.py"
MUTANTS = (
    # Renderers: the march, the brackets, the gradients.
    M("renderers/march.py", "value.abs() < stepping.epsilon", "value.abs() < 2 * stepping.epsilon", "tests/renderers"),
    M("renderers/march.py", "(self.alpha - 1) * value", "self.alpha * value", "tests/renderers"),
    M("renderers/march.py", "value.clamp(-self.step_clamp, self.step_clamp)", "value", "tests/renderers"),
    M("renderers/march.py", "PYRAMID_STEPS = 3", "PYRAMID_STEPS = 2", "tests/renderers"),
    M("renderers/march.py", "values.abs().argsort(dim=1, stable=True)", "values.argsort(dim=1, stable=True)",
      "tests/renderers"),
    M("renderers/march.py", "status[left] = Status.MISS", "status[left] = Status.HIT", "tests/renderers"),
    M("renderers/march.py", "least <= CAREFUL * apart", "least >= CAREFUL * apart", "tests/renderers"),
    M("renderers/bracket.py", "(value[:, 1:] <= 0)", "(value[:, 1:] < -0.1)", "tests/renderers"),
    M("renderers/bracket.py", "self.near_value / (self.near_value - self.far_value)", "0.5",
      "tests/renderers"),
    M("renderers/gradients.py", "distance + alpha * (total - total.detach())", "distance + (total - total.detach())",
      "tests/renderers"),
    M("renderers/gradients.py", "distance.detach() - at.change / slope", "distance.detach() + at.change / slope",
      "tests/renderers"),
    M("renderers/gradients.py", "slope.clamp_max(-least_slope)", "slope.clamp_max(0.0)", "tests/renderers"),
    M("renderers/gradients.py", "total = table.sum(dim=1)", "total = table.mean(dim=1)", "tests/renderers"),
    M("renderers/packed_march.py", "(behind & ~own & ~begins) | (above & ~left)", "above & ~left",
      "tests/renderers/test_newton.py"),
    M("renderers/packed_march.py", "(at + value > self.leave)", "(at + stride.length(value, value) > self.leave)",
      "tests/renderers/test_newton.py"),
    M("renderers/packed_march.py", "begins & (value < 0) & ~own", "begins & behind & ~own",
      "tests/renderers/test_newton.py"),
    M("renderers/tracer.py", "torch.where(known.free_value.isfinite(), known.free, known.entry)",
      "known.distance", "tests/renderers/test_newton.py"),
    M("renderers/tracer.py", "solved.index, solved.settled", "solved.index, solved.value.isfinite()",
      TRACED),
    M("renderers/tracer.py", "at + step - found.change / slope", "at - found.change / slope", TRACED),
    M("renderers/tracer.py", "(reached.grazed > error)", "(reached.grazed > 0)", TRACED),
    M("renderers/tracer.py", "reached.stopped(Stop.LEFT).index_put((first.index,), first.settled) & ", "",
      TRACED),
    M("renderers/tracer.py", "first.some(certain[first.index])", "first.some(first.settled)", TRACED),
    M("renderers/packed_march.py", "torch.where(rises | left, lower", "torch.where(rises, lower",
      TRACED),
    M("renderers/packed_march.py", "reach - apart - error", "reach - error", TRACED),
    M("renderers/packed_march.py", "clear = HOLDS * (", "clear = 0.5 * (", TRACED),
    M("renderers/packed_march.py", "(value > epsilon) & finite", "(value > epsilon)", TRACED),
    M("renderers/packed_march.py", "((safe - value) / went).nan_to_num(1.0)", "(safe - value) / went", TRACED),
    M("renderers/packed_march.py", "keeps & (start >= child.leave)", "inherits & (start >= child.leave)", TRACED),
    M("renderers/packed_march.py", "~ended & (child.passed > CLEAR)", "(child.passed > CLEAR)", TRACED),
    M("renderers/packed_march.py", "torch.minimum(start, child.leave)", "start", TRACED),
    M("renderers/packed_march.py", "for distance in (begin, end)", "for distance in (end, end)", TRACED),
    M("renderers/tracer.py", "torch.maximum(step, reached.entry[ray] - at)", "step", TRACED),
    M("renderers/tracer.py", "short &= at + step <= reached.leave[ray]", "", TRACED),
    M("renderers/evened.py", "steepness > STEEP", "steepness > torch.inf", EVENED),
    M("renderers/evened.py", "STEEP = 1.2", "STEEP = 1.0", EVENED),
    M("renderers/evened.py", "[here.isfinite() & there.isfinite()]", "", EVENED),
    M("renderers/evened.py", "SPAN * radius * towards", "SPAN * towards", EVENED),
    M("renderers/evened.py", "offered.error / by", "offered.error", EVENED),
    M("renderers/warm.py", "image.renderings % MEASURED == 0", "False", TRACED),
    M("renderers/tracer.py", "residual=steepness * residual", "residual=residual", TRACED),
    M("renderers/tracer.py", "steepness * closest[queried]", "closest[queried]", TRACED),
    M("renderers/tracer.py", "field.kind is not Kind.DISTANCE", "False", TRACED),
    M("renderers/packed_march.py", "else 0.0) + error", "else 0.0)", TRACED),
    M("renderers/packed_march.py", "torch.where(left, at + value, at)", "torch.where(left, self.leave, at)", TRACED),
    M("renderers/packed_march.py", "torch.where(spheres, known.free + known.free_value, known.distance)",
      "known.distance", TRACED),
    M("renderers/packed_march.py", " | (known.stopped(Stop.ON_THE_WAY) & known.free_value.isfinite())", "", TRACED),
    M("renderers/packed_march.py", "too_far = finite & (went", "too_far = above & (went", TRACED),
    M("renderers/packed_march.py", "torch.where(from_behind, torch.inf, value)", "value", TRACED),
    M("renderers/packed_march.py", "torch.minimum(self.leave, self.wall)", "self.leave", TRACED),
    M("renderers/packed_march.py", " & self.wall.isinf()", "", TRACED),
    M("renderers/packed_march.py", "> TOLERATED * stride.unseen", "> torch.inf", TRACED),
    M("renderers/packed_march.py", "torch.where(too_far, self.free + safe,", "torch.where(too_far, at,", TRACED),
    M("renderers/packed_march.py", "positive = above & ~too_far", "positive = above", TRACED),
    M("renderers/tracer.py", "solved.begun[asked] if steps_before else found.value", "found.value", TRACED),
    M("renderers/packed_march.py", "step, value + FURTHER", "step, value + 1", TRACED),
    M("renderers/packed_march.py", "(GAP * value).clamp_max(self.unseen)", "self.unseen", TRACED),
    M("renderers/tracer.py", "max(self.march_epsilon, NO_NEARER * error)", "self.march_epsilon", TRACED),
    M("renderers/packed_march.py", "above, behind = (value > epsilon)", "above, behind = (value > 0)", TRACED),
    M("renderers/tracer.py", "LONGEST * steep * steep.clamp_max(1.0)", "LONGEST * -found.slope", TRACED),
    M("renderers/tracer.py", "small = (found.value <= 0) & (", "small = (found.value <= 1e-4) & (", TRACED),
    M("renderers/tracer.py", "reached.passed -= error", "pass", TRACED),
    M("renderers/fields/bfloat16.py", "MARGIN * _largest_error", "0.5 * _largest_error", COARSE),
    M("renderers/fields/bfloat16.py", "if at == skip else", "if at == skip + 1 else", COARSE),
    M("renderers/field.py", "self.counts.coarse += points", "self.counts.value += points", COARSE),
    M("renderers/field.py", "(self.value + self.coarse)", "self.value", COARSE),
    M("bench/machine/limits.py", "offered.noted(self._spend)", "offered", COARSE),
    M("renderers/warm.py", "margin = 2 * (moved - self.marched)", "margin = 0 * (moved - self.marched)",
      "tests/renderers/test_warm.py"),
    M("renderers/warm.py", "return bool((~free).sum() <= MARCHED * len(free))", "return True",
      "tests/renderers/test_warm.py"),
    M("renderers/warm.py", "torch.maximum(_largest(solved.begun), _largest(looked - image.looked))",
      "_largest(solved.begun)", "tests/renderers/test_warm.py"),
    M("renderers/warm.py", "certain = free & ", "certain = ", "tests/renderers/test_warm.py"),
    M("renderers/warm.py", "return differing > max(1, SHARE * rays)", "return False", "tests/renderers/test_warm.py"),
    M("renderers/warm.py", "image.note(solved)\n    return image", "return image", "tests/renderers/test_warm.py"),
    M("renderers/warm.py", "reached.put_back(index, moving)", "pass", "tests/renderers/test_warm.py"),
    M("renderers/warm.py", "memory.thread != get_ident()", "False", "tests/renderers/test_warm.py"),
    M("renderers/rendering.py", "return rendering.closest.flatten().index_put((index,), values).view(rays.shape)",
      "return rendering.closest", "tests/renderers"),
    M("renderers/gradients.py", "gradient.nan_to_num(0.0, 0.0, 0.0)", "gradient", "tests/renderers/test_newton.py"),
    M("renderers/camera.py", "torch.arange(self.height, **like) + 0.5", "torch.arange(self.height, **like)",
      "tests/renderers"),
    M("renderers/camera.py", "return distance / torch.linalg.vector_norm(self._bearings(), dim=-1)", "return distance",
      "tests/renderers"),
    M("renderers/camera.py", "self.world_to_camera @ rigid(twist)", "rigid(twist) @ self.world_to_camera",
      "tests/renderers"),
    M("renderers/dvr.py", "self.n_ray_samples // 2**to_come", "self.n_ray_samples", "tests/renderers"),
    M("renderers/dvr.py", "found < 0 if sample == 0 else found <= 0", "found < -0.1", "tests/renderers"),
    M("renderers/field.py", "self.counts.value += values.numel()", "self.counts.value += len(values)",
      "tests/renderers"),
    # Losses.
    M("renderers/silhouette.py", "self._excess(closest, mask).clamp_min(0)", "self._excess(closest, mask).abs()",
      "tests/renderers/test_silhouette.py"),
    M("renderers/silhouette.py", "wrong = silent | (violates", "wrong = (violates",
      "tests/renderers/test_silhouette.py"),
    M("renderers/silhouette.py", "closest if self.signed else closest.abs()", "closest",
      "tests/renderers/test_silhouette.py"),
    M("renderers/silhouette.py", "entropy * ~(mask & rendering.hit)", "entropy", "tests/renderers"),
    M("renderers/silhouette.py", "self.weight * total / (self.sharpness * max(mask.numel(), 1))",
      "self.weight * total / max(mask.numel(), 1)", "tests/renderers"),
    M("renderers/silhouette.py", "meets & ~(wanted & hit)", "meets", "tests/renderers"),
    M("renderers/silhouette.py", "wanted & (given >= entry) & (given <= leave)", "given.isfinite()",
      "tests/renderers/test_dvr.py"),
    M("renderers/silhouette.py", "self.occupied_at == DEPTH and", "", "tests/renderers/test_dvr.py"),
    M("renderers/boundary.py", "if isinstance(renderer, Guided):", "if False:", "tests/renderers/test_boundary.py"),
    M("bench/solve/observed_view.py", "torch.where(self.observed, self.depth / self.depth_of_distance, torch.nan)",
      "self.depth / self.depth_of_distance", "tests/tasks/test_completion.py"),
    M("bench/tasks/pose.py", "self.depth / at_one, torch.nan", "self.depth, torch.nan", "tests/tasks/test_pose.py"),
    M("bench/solve/observed_view.py", "self.settings.silhouette_weight * silhouette", "silhouette",
      "tests/tasks/test_completion.py"),
    M("bench/solve/observed_view.py", "error / at_one if loss == POINTS", "error if loss == POINTS",
      "tests/tasks/test_completion.py"),
    M("bench/solve/latent_code.py", 'squares.sum() if self.average == "sum" else squares.mean()', "squares.sum()",
      "tests/tasks/test_completion.py tests/solve"),
    M("bench/tasks/photographs.py", "self.settings.photometric_weight * together.mean()", "together.mean()",
      "tests/tasks/test_multiview.py"),
    M("bench/shape_prior/autodecoder.py", "settings.code_penalty * codes[chosen]", "0.0 * codes[chosen]",
      "tests/shape_prior"),
    M("bench/solve/optimise.py", "if (gradient := one.grad) is not None", "if (gradient := one.grad) is not self",
      "tests/solve"),
    M("bench/solve/optimise.py", "DIVERGED = 100.0", "DIVERGED = 1e9", "tests/solve"),
    # Sizes of fields, and the choice by one of them.
    M("bench/models/choice.py", "candidate.size.by(measure)", "candidate.size.free", "tests/models/test_sizes.py"),
    M("bench/models/model.py", "Size(free, free + self.held,", "Size(free, free,", "tests/models/test_models.py"),
    M("bench/models/candidates.py", "listed if measure == FREE else", "listed if measure != FREE else",
      "tests/models/test_sizes.py"),
    # Stress tests: trials, their judges, the search.
    M("bench/stress/rendering.py", "both & (error > footprint)", "both & (error > 4 * footprint)", "tests/stress"),
    M("bench/stress/rendering.py", '(numbers["hits"] or rays)', "rays", "tests/stress"),
    M("bench/stress/rendering.py", "width / incidence_cosines(exam.truth.field, rays, first)",
      "width * incidence_cosines(exam.truth.field, rays, first)", "tests/stress"),
    M("bench/stress/axes.py", "max(round(severity), 1)", "round(severity)", "tests/stress"),
    M("bench/stress/axes.py", "return exp(log(self.mild) + level *",
      "return exp(log(self.severe) + level *", "tests/stress"),
    M("bench/stress/gradient.py", "abs(scale - 1) > criteria.scale", "scale - 1 > criteria.scale", "tests/stress"),
    M("bench/stress/gradient.py", "float((computed * true).sum() / true.square().sum())",
      "float((computed * true).sum() / computed.square().sum())", "tests/stress"),
    M("bench/stress/fit.py", "self.watched.inner = _sphere(self.free).field", "self.__post_init__()", "tests/stress"),
    M("bench/stress/fit.py", "error <= largest", "error <= 10 * largest", "tests/stress"),
    M("bench/stress/search.py", "LAPSE = 0.02", "LAPSE = 0.4", "tests/stress/test_search.py"),
    M("bench/stress/search.py", "if failure - success > 1 else None", "if failure - success > 2 else None",
      "tests/stress/test_search.py"),
    M("bench/stress/search.py", "int(np.argmin(succeeds * after[0]", "int(np.argmax(succeeds * after[0]",
      "tests/stress/test_search.py"),
    # Fields to choose from: fits, held-out rays, growth.
    M("bench/models/choice.py", "best.mean + best.standard_error", "best.mean", "tests/models"),
    M("bench/models/choice.py", "or candidate.mean <= footprint]", "]", "tests/models"),
    M("bench/models/held_out.py", "(count - 1) / count * np.square", "1 / count * np.square", "tests/models"),
    M("bench/models/held_out.py", "rendering.hit ^ self.mask", "rendering.hit & ~self.mask", "tests/models"),
    M("bench/models/held_out.py", "self.distance)[compared].abs() * cosine)", "self.distance)[compared].abs())",
      "tests/models"),
    M("bench/models/growth.py", "> new.error.noise_of_difference(old.error)", "> 0", "tests/models"),
    M("bench/models/growth.py", "others + cost(larger, trial, fitter) > kept or ", "", "tests/models"),
    M("bench/models/observations.py", "given.observed | ~given.mask", "given.observed", "tests/models"),
    M("bench/models/observations.py", "(out & view.observed if view.mask is None else out)", "out", "tests/models"),
    M("bench/models/warm_start.py", "(-shape(_some(self.free, self.count, draw))).clamp_min(0)",
      "shape(_some(self.free, self.count, draw)).clamp_min(0)", "tests/models"),
    M("bench/models/fit.py", "screened = self.settings.warm_iterations // SCREENING", "screened = 0", "tests/models"),
    M("bench/models/fit.py", "torch.linalg.vector_norm(gradient, dim=-1) - 1)",
      "torch.linalg.vector_norm(gradient, dim=-1))", "tests/models"),
    # Datasets: meshes and their repair, views, photographs.
    M("datasets/mesh.py", "weights=(heights * self.crosses).sum(axis=1) / 6",
      "weights=(heights * self.crosses).sum(axis=1) / 3", "tests/datasets"),
    M("datasets/mesh.py", "return centre, radius / farthest", "return centre, radius", "tests/datasets"),
    M("datasets/truth.py", "np.sqrt(generator.random(count))",
      "generator.random(count)", "tests/datasets/test_truth.py"),
    M("datasets/truth.py", "[origins, directions / lengths]", "[origins, directions]", "tests/datasets/test_truth.py"),
    M("datasets/extract.py", "STEEPER = 1.2", "STEEPER = 0.12", "tests/datasets/test_extract.py"),
    M("datasets/extract.py", "while (found :=", "if (found :=", "tests/datasets/test_extract.py"),
    M("datasets/extract.py", "max(MARGIN, STEEPER * steepest)", "MARGIN", "tests/datasets/test_extract.py"),
    M("datasets/extract.py", "BLOCKS = (4, 2)", "BLOCKS = (4,)", "tests/datasets/test_extract.py"),
    M("datasets/deform.py", "1 / curvature - radius * np.cos(angle)", "1 / curvature + radius * np.cos(angle)",
      "tests/datasets/test_deform.py"),
    M("datasets/deform.py", "* np.exp(self.stretch)",
      "* (1 - np.array(self.stretch))", "tests/datasets/test_deform.py"),
    M("datasets/views.py", "self.resolution / 2 / tan(",
      "self.resolution / tan(", "tests/datasets tests/renderers/test_camera.py"),
    M("datasets/views.py", "torch.linalg.cross(forward, right), forward", "torch.linalg.cross(right, forward), forward",
      "tests/datasets"),
    M("datasets/observe.py", "float(text.removesuffix(\"%\")) / 100", "float(text.removesuffix(\"%\"))",
      "tests/datasets/test_observe.py"),
    M("datasets/observe.py", "foreground[order[:count]]", "foreground[:count]", "tests/datasets/test_observe.py"),
    M("datasets/photographs.py", "AMBIENT + (1 - AMBIENT) *", "(1 - AMBIENT) *", "tests/datasets/test_photographs.py"),
    M("datasets/photographs.py", "= c, s, -s, c", "= c, -s, s, c", "tests/datasets/test_photographs.py"),
    M("datasets/repair.py", "outward[part] = bool((sign * _winding(points, mesh.vertices, around) > 0.5).all())",
      "outward[part] = False", "tests/datasets"),
    M("datasets/repair.py", "CHANGED = 0.25", "CHANGED = 25.0", "tests/datasets"),
    M("datasets/repair.py", "double_sided = first[~np.isin(parts[first], parts[keep])]", "double_sided = first[:0]",
      "tests/datasets"),
    M("datasets/truncated.py", "if claimed > held:", "if claimed > held + 1:", "tests/datasets/test_truncated.py"),
    # Renderers' samples that follow the shape, the baseline, fields.
    M("renderers/adaptive_samples.py", "4 * radius / thinnest", "2 * radius / thinnest",
      "tests/renderers/test_adaptive_samples.py"),
    M("renderers/adaptive_samples.py", "found[int(SHARE * len(found))]", "found[0]",
      "tests/renderers/test_adaptive_samples.py"),
    M("renderers/adaptive_samples.py", "min(self.seen.thinnest, found)", "found",
      "tests/renderers/test_adaptive_samples.py"),
    M("renderers/adaptive_samples.py", "replace(self, seen=Seen())", "self",
      "tests/renderers/test_adaptive_samples.py tests/models"),
    M("renderers/naive.py", "moved = torch.where(active, distance + value, distance)",
      "moved = torch.where(active, distance + value.detach(), distance)", "tests/renderers"),
    M("renderers/naive.py", "left = active & ~converged & (moved > leave)", "left = active & (moved > leave + 1)",
      "tests/renderers"),
    M("renderers/reference.py", "(value / lipschitz).clamp_min(least_step)", "value.clamp_min(least_step)",
      "tests/renderers/test_reference.py"),
    M("renderers/fields/analytic.py", "return self(points / axes) * axes.min()",
      "return self(points / axes) * axes.max()", "tests/renderers/test_fields.py"),
    M("renderers/fields/analytic.py", "- 0.25 * width * overlap**2", "- 0.5 * width * overlap**2",
      "tests/renderers/test_fields.py"),
    M("renderers/fields/grid.py", "inside.square() + away", "away", "tests/renderers/test_grid.py"),
    M("renderers/fields/moved.py", "return scale * self.inner((points", "return self.inner((points",
      "tests/renderers tests/tasks/test_pose.py"),
    M("renderers/fields/mlp.py", "return Flops(value, value if self._frozen else 2 * value)",
      "return Flops(value, value)", "tests/renderers"),
    M("renderers/fields/mlp.py", "towards_points = towards_points + again", "towards_points = towards_points",
      "tests/renderers/test_decoder.py"),
    M("renderers/field.py", "STEEPEST_MARGIN = 1.2", "STEEPEST_MARGIN = 0.8", "tests/renderers"),
    M("bench/evaluate/evaluate.py", "np.mean(to_truth**2) + np.mean(to_predicted**2)",
      "np.mean(to_truth**2) + np.mean(to_truth**2)", "tests/evaluate"),
    M("bench/evaluate/evaluate.py", 'float(np.mean(to_predicted**2)),', 'float(np.mean(to_truth**2)),',
      "tests/evaluate"),
    M("bench/evaluate/evaluate.py", "np.mean(to_truth < threshold)", "np.mean(to_truth < 2 * threshold)",
      "tests/evaluate"),
    M("bench/evaluate/evaluate.py", "common.sum() / either.sum()", "common.sum() / true.sum()", "tests/evaluate"),
    M("bench/evaluate/evaluate.py", "DEPTH_CAP = 0.1", "DEPTH_CAP = 0.2", "tests/evaluate"),
    M("bench/evaluate/evaluate.py", "see(Truth(mesh, closed=False), truth.camera)",
      "render_view(field, truth.camera, inputs)", "tests/evaluate"),
    M("bench/evaluate/reference.py", "LEAST_STEP = 2e-4", "LEAST_STEP = 2e-2", "tests/evaluate"),
    M("bench/stress/search.py", "(success + failure) / 2 / (self.settings.levels - 1)",
      "success / (self.settings.levels - 1)", "tests/stress/test_search.py"),
    M("datasets/stress/scenes.py", "made.surface or cube", "cube", "tests/stress/test_stress.py"),
    M("datasets/stress/distortions.py", "0.5 * 2.0**-bits", "2.0**-bits", "tests/stress/test_stress.py"),
    M("datasets/stress/distortions.py", "- severity / 2)", "- severity)", "tests/stress/test_stress.py"),
    M("datasets/families.py", "(abs(slope) + sqrt(slope**2 + 4)) / 2", "1.0", "tests/datasets/test_families.py"),
    M("conf/stress/camera_inside.yaml", "repeats: 1", "repeats: null", "tests/stress/test_stress.py"),
    M("bench/report/data/subjects/atlas.py", 'return self.stress("repeats") == 1', "return False",
      "tests/report/test_report_stability.py"),
    M("bench/report/data/experiments.py", "if len(labels) == 1 else", "if labels else",
      "tests/report/test_report_stability.py"),
    M("bench/setup/auto.py", "settings.spurious * settings.area_over_perimeter)", "1.0)", "tests/setup"),
    M("bench/setup/auto.py", "depth / (2 * focal_length)", "depth / focal_length", "tests/setup"),
    # Statistics.
    M("bench/report/data/statistics.py", "2 * float(chance", "1 * float(chance",
      "tests/report/test_statistics.py"),
    M("bench/report/data/statistics.py", "math.sqrt(n / (n - 1)) * stats.t.ppf((1 - level) / 2, n - 1)",
      "stats.norm.ppf((1 - level) / 2)", "tests/report/test_statistics.py"),
    M("bench/report/data/statistics.py", "np.arange(len(p), 0, -1)", "len(p)", "tests/report/test_statistics.py"),
    M("bench/report/data/statistics.py", "fillna(len(table)).mean()", "mean()", "tests/report/test_statistics.py"),
    M("bench/report/data/statistics.py", "FEWEST_SHAPES = 6", "FEWEST_SHAPES = 2", "tests/report/test_statistics.py"),
    M("bench/report/data/statistics.py", "clopper_pearson(value, len(k), level=level)",
      "clopper_pearson(value, m.sum(), level=level)", "tests/report/test_statistics.py"),
    M("bench/report/data/statistics.py", "((a < b) + 0.5 * (a == b)).sum()", "((a < b) + 1.0 * (a == b)).sum()",
      "tests/report/test_statistics.py"),
    M("bench/report/data/statistics.py", "stats.beta.ppf(1 - tail, k + 1, n - k)", "stats.beta.ppf(1 - tail, k, n - k)",
      "tests/report/test_statistics.py"),
    M("bench/report/data/statistics.py", "if points and not several(points[0][0]):", "if not points:",
      "tests/report/test_statistics.py"),
    M("bench/report/data/statistics.py", "left * (1 - left) / variance, at_risk", "at_risk[0], at_risk",
      "tests/report/test_statistics.py"),
    M("bench/report/data/records.py", "None if _is_view(record) else index(record)", "index(record)",
      "tests/report/test_report_views.py"),
    M("bench/report/data/statistics.py", "* np.std(logs, ddof=1) / math.sqrt(n)", "* np.std(logs) / math.sqrt(n)",
      "tests/report/test_statistics.py"),
    # The crossing of renderers and losses, and the tuning.
    M("bench/report/pages/completion/crossing_gaps.py",
      "((first, mine), (first, other)), ((second, mine), (second, other))", "((first, mine),), ((second, mine),)",
      "tests/report/test_report_crossing.py"),
    M("bench/report/data/subjects/crossing.py", '"renderers.IDR": "CrossEntropy"', '"renderers.IDR": "Hinge"',
      "tests/report/test_report_crossing.py"),
    M("bench/report/data/subjects/completions.py", "max(worst[run], default=e)", "min(worst[run], default=e)",
      "tests/report/test_report_crossing.py"),
    M("bench/report/data/subjects/tuning.py", "np.lexsort((self.scores, self.failures))",
      "np.argsort(self.test.mean(axis=1))", "tests/report/test_report_tuning.py"),
    M("bench/report/data/subjects/tuning.py", "math.comb(n - place - 1, k - 1)", "math.comb(n - place, k)",
      "tests/report/test_report_tuning.py"),
    M("bench/report/data/subjects/tuning.py", 'UNFINISHED = (NOT_RUN, "killed")', "UNFINISHED = (NOT_RUN,)",
      "tests/report/test_report_tuning.py"),
    M("bench/rows.py", "(most / least) **", "1 + (most / least - 1) *", "tests/conf/test_spaces.py"),
    M("bench/report/data/statistics.py", "(other[0] < mine[0]) | (other[1] < mine[1])",
      "(other[0] <= mine[0]) | (other[1] <= mine[1])", "tests/report/test_statistics.py"),
    # Published numbers, and numbers of papers in YAML.
    M("bench/report/pages/rendering/table1.py", '"887K"', '"787K"', "tests/report/test_published.py"),
    M("bench/report/pages/completion/table2.py", "4.12, 3.98, 4.31", "4.12, 2.98, 4.31",
      "tests/report/test_published.py"),
    M("bench/report/pages/views/table3.py", '"DIST, random start": 0.919', '"DIST, random start": 0.991',
      "tests/report/test_published.py"),
    M("conf/renderer/idr.yaml", "mask_weight: 100.0", "mask_weight: 1.0", "tests/conf/test_numbers.py"),
    M("conf/renderer/dist_official.yaml", "step_clamp: 0.1", "step_clamp: 1.0", "tests/conf/test_numbers.py"),
    M("conf/method/dist_mask_paper.yaml", "silhouette_weight: 1.0", "silhouette_weight: 10.0",
      "tests/conf/test_numbers.py"),
    M("conf/task/multiview.yaml", "photometric_weight: 5.0", "photometric_weight: 1.0", "tests/conf/test_numbers.py"),
    M("conf/silhouette/occupancy.yaml", "weight: 3.0", "weight: 1.0", "tests/renderers/test_silhouette.py"),
)  # fmt: skip


def main() -> int:
    """Plants all mistakes, prints the outcome of each, and gives 1 where one survives."""
    word = os.environ.get("ONLY", "")
    chosen = [mutant for mutant in MUTANTS if word in f"{mutant.file} {mutant.old}"]
    survivors = []
    for tests in dict.fromkeys(mutant.tests for mutant in chosen):
        if is_found(None, tests):
            raise RuntimeError(f"{tests} fail without any mistake: mend them first")
    with ThreadPoolExecutor(WORKERS) as pool:
        for mutant, found in zip(chosen, pool.map(is_found, chosen), strict=True):
            print("found   " if found else "SURVIVES", f"{mutant.file}: {mutant.old} -> {mutant.new}", flush=True)
            survivors += [] if found else [mutant]
    print(f"{len(chosen)} planted, {len(survivors)} survive")
    return bool(survivors)


def is_found(mutant: Mutant | None, tests: str = "") -> bool:
    """Whether the tests of a mistake fail on a copy of the project with it; without one, whether `tests` do."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in subprocess.check_output(["git", "ls-files", "-z"], cwd=ROOT, text=True).split("\0")[:-1]:
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            copy2(ROOT / name, copy / name)
        if mutant is not None:
            tests = mutant.tests
            (copy / mutant.file).write_text(planted_in(copy / mutant.file, mutant))
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests.split()]
        environment = os.environ | {"PYTHONPATH": folder, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True)
        if done.returncode not in (0, 1):  # 1: a test failed; others: pytest could not run them
            raise RuntimeError(f"{mutant}: pytest ended with {done.returncode}\n{done.stdout}{done.stderr}")
        return done.returncode == 1


def planted_in(file: Path, mutant: Mutant) -> str:
    """The file's text with the mistake.

    Raises:
        ValueError: unless `old` stands once in it.
    """
    text = file.read_text()
    if text.count(mutant.old) != 1:
        raise ValueError(
            f"{mutant.file} must have {mutant.old!r} once, not {text.count(mutant.old)} times: mend the list"
        )
    return text.replace(mutant.old, mutant.new)


if __name__ == "__main__":
    sys.exit(main())
