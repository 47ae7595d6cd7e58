"""Numbers of the papers in YAML files, typed a second time."""

from tests.looped import each

# Override of the default configuration, key, value, and the source in the paper.
STATED = [
    ("renderer=idr", "renderer.mask_weight", 100.0, "IDR: rho"),
    ("renderer=idr", "renderer.mask_sharpness", 50.0, "IDR: its sharpness at the start"),
    ("renderer=idr", "renderer.epsilon", 5e-5, "IDR"),
    ("silhouette=cross_entropy", "silhouette.weight", 100.0, "IDR: rho"),
    ("silhouette=cross_entropy", "silhouette.sharpness", 50.0, "IDR: at the start"),
    # Of DIST's and DVR's variants: test_conf.
    ("renderer=dist", "renderer.alpha", 1.5, "DIST, A.1"),
    ("renderer=dist", "renderer.epsilon", 5e-5, "DIST, A.1"),
    ("renderer=dvr", "renderer.refinement_steps", 8, "DVR, official code"),
    ("+method=dist_mask_paper", "task.depth_weight", 10.0, "DIST, B.4"),
    ("+method=dist_mask_paper", "task.silhouette_weight", 1.0, "DIST, B.4"),
    ("+method=dist_mask_paper", "task.code.weight", 1.0, "DIST, B.4"),
    ("+method=dist_mask_paper", "task.code.average", "mean", "DIST, official code"),
    ("+method=multiview_paper", "task.views_per_step", 8, "DIST, B.4"),
    ("task=multiview", "task.photometric_weight", 5.0, "DIST, B.4"),
    ("scale=paper", "scale.multiview.views", 72, "DIST, B.4"),
    ("scale=paper", "scale.multiview.iterations", 180, "DIST, B.4: 9 iterations, 20 times"),
    ("scale=paper", "scale.iterations", 100, "DIST, B.4"),
    ("scale=paper", "scale.rendering", 512, "DIST, Table 1"),
    ("prior=autodecoder", "prior.code_penalty", 1e-4, "DeepSDF, official code"),
]


@each("override, key, value, where", STATED)
def test_a_number_of_a_paper_is_as_stated(compose_config, override, key, value, where):
    node = compose_config(override)
    for name in key.split("."):
        node = node[name]
    assert node == value, where
