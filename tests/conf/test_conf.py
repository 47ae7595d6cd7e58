"""Every YAML in conf composes and builds; a mistake in one is told with its key and the nearest right one."""

from dataclasses import fields, replace
from functools import cache
from typing import Any

import pytest
import trimesh
import yaml
from hydra import initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from bench.config import CONF, build, check_draw, check_names, load
from bench.hints import nearest
from bench.pictures import style
from bench.pictures.style import look
from bench.run.compose import combinations
from bench.tables import GROUPS, choice, names, read_yaml
from bench.tasks.task import Task
from datasets.dataset import Dataset
from renderers import DIST, DVR, Naive
from renderers.rendering import Renderer
from renderers.silhouette import SilhouetteLoss
from tests.composing import composed
from tests.made_scans import write_scans

IDR_ARGUMENTS = {
    "steps": 7,
    "epsilon": 1e-4,
    "least_slope": 1e-3,
    "mask_sharpness": 50.0,
    "mask_weight": 100.0,
    "sphere_radius": 1.0,
}
EXPERIMENTS = [name for name in names("experiment") if not name.startswith("_")]
SINGLE = {"fitted"}  # of one run, and without a table or figure of its own
# The table or figure of an experiment, where it has another name: one that joins several experiments.
JOINED = {"fig10_focal": "fig10", "fig10_start": "fig10"}
SHARED_ROWS = {"speed_accuracy": "speed_completion"}  # an experiment that sweeps over rows that several share
COMPARING = {"table1": 22, "fig4": 7, "fig5": 8, "stability": 21, "gradients": 12, "speed_accuracy": 30}  # renderers
COMPARING["crossing"] = 5
KINDS = {"renderer": Renderer, "task": Task, "dataset": Dataset, "silhouette": SilhouetteLoss}
TARGETS = {"prior": "bench.shape_prior.autodecoder.PriorSettings"}  # nodes whose class the code knows
PARTS = ("task", "renderer", "dataset", "prior", "silhouette")
CUSTOM = ("renderer._target_=renderers.IDR", *(f"+renderer.{k}={v}" for k, v in IDR_ARGUMENTS.items()))


def visible(group: str) -> list[str]:
    """The choices of a group that are no mere base of others."""
    return [name for name in names(group) if not name.startswith("_")]


def together() -> list[dict[str, str]]:
    """Choices of all groups, so that each stands in a composition, which takes a tenth of a second."""
    stresses, tasks = visible("stress"), [name for name in visible("task") if name != "stability"]
    stresses.remove("none")
    judged = [("stability", stress) for stress in stresses] + [(task, "none") for task in tasks]
    columns = {group: visible(group) for group in names_of_groups() if group not in ("task", "stress")}
    count = max(len(judged), *map(len, columns.values()))
    rows = [{group: column[at % len(column)] for group, column in columns.items()} for at in range(count)]
    return [row | dict(zip(("task", "stress"), judged[at % len(judged)], strict=True)) for at, row in enumerate(rows)]


def names_of_groups() -> tuple[str, ...]:
    return ("task", "renderer", "dataset", "silhouette", "stress", "supervision", "prior", "scale", "tracker")


TOGETHER = together()
METHODS = [*visible("method"), *(f"{kind}/{name}" for kind in ("space", "tuned") for name in visible(f"method/{kind}"))]


@pytest.fixture(scope="session")
def paths(tmp_path_factory) -> dict[str, str]:
    """What the datasets of files need as `dataset.path`."""
    mesh, scans = tmp_path_factory.mktemp("mesh") / "box.obj", tmp_path_factory.mktemp("scans")
    trimesh.creation.box().export(mesh)
    return {"mesh": str(mesh), "photos": str(mesh.parent), "scans": str(write_scans(scans))}


@cache
def cells(name: str) -> list[list[str]]:
    """The first and the last cell of an experiment at desk scale, as overrides."""
    params = composed(f"+experiment={name}", hydra=True).hydra.sweeper.get("params") or {}
    with initialize_config_dir(str(CONF), version_base="1.3"):  # a glob asks for the choices of its group
        swept = combinations([f"{key}={values}" for key, values in params.items()])
    return [swept[0], swept[-1]]


def build_part(config: DictConfig, part: str):
    return build(config[part], part, list(config.packages), TARGETS.get(part, ""))


def test_no_yaml_lies_where_it_is_not_looked_for():
    assert {path.stem for path in CONF.glob("*.yaml")} == {"config", *GROUPS}
    folders = {path.parent.relative_to(CONF).as_posix() for path in CONF.rglob("*.yaml")} - {"."}
    files = {"task", "renderer", "dataset", "prior", "scale", "tracker", "experiment", "hydra/launcher"}
    assert folders <= files | {*GROUPS.values(), "method/space"}


def test_no_yaml_sets_the_mode_of_hydra():
    assert composed(hydra=True).hydra.mode is None  # the fixture `asked_once` of the tests says so to Hydra
    for path in CONF.rglob("*.yaml"):
        assert "mode" not in (read_yaml(path).get("hydra") or {}), path


@pytest.mark.parametrize("table", GROUPS)
def test_a_table_has_no_row_twice_and_no_text_that_should_be_a_number(table):
    """Which plain YAML does not tell: of two rows it takes the last, and 1e-3 is a text to it."""
    strict = OmegaConf.to_container(OmegaConf.load(CONF / f"{table}.yaml"), resolve=False)
    assert strict == read_yaml(CONF / f"{table}.yaml")
    assert not {path.stem for path in (CONF / GROUPS[table]).glob("*.yaml")} & {*strict}


def test_the_default_configuration_builds(compose_config):
    config = compose_config()
    for part in PARTS:
        build_part(config, part)
    build(config.view, "view", target="datasets.views.ViewSampler")
    build(config.evaluation, "evaluation", target="bench.config.EvaluationSettings")


def builds(config: DictConfig) -> None:
    """Asserts that all of a configuration resolves, and that its parts are what their places ask for."""
    OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    made = {part: build_part(config, part) for part in PARTS}  # a scale is read by the others
    assert all(isinstance(made[part], kind) for part, kind in KINDS.items())
    build(config.view, "view", target="datasets.views.ViewSampler")


def test_every_choice_is_in_a_composition():
    for group in names_of_groups():
        assert {row[group] for row in TOGETHER} == {*visible(group)}
    assert len(METHODS) > 80 and len({row["renderer"] for row in TOGETHER}) > 50


@pytest.mark.parametrize("row", TOGETHER, ids=lambda row: " ".join(row.values()))
def test_every_choice_composes_and_builds(paths, row):
    needed = [f"dataset.path={path}" for name, path in paths.items() if name == row["dataset"]]
    needed += CUSTOM if row["renderer"] == "custom" else ()
    config = composed(*(f"{group}={name}" for group, name in row.items()), *needed)
    builds(config)
    if row["stress"] != "none":
        assert build_part(config, "task").stress.scene == choice("stress", row["stress"])["scene"]
    renderer = build_part(config, "renderer")
    if row["renderer"] != "custom":
        alone = load("renderer", row["renderer"])
        steps = {name: getattr(renderer, name) for name in ("sharpening",) if hasattr(renderer, name)}  # the task's
        assert replace(alone, **steps) == renderer
    assert load("silhouette", row["silhouette"]) == build_part(config, "silhouette")


@pytest.mark.parametrize("name", METHODS)
def test_every_method_composes_and_builds(name):
    builds(composed(f"+method={name}", *(["draw=0"] if name.startswith("space/") else [])))


@pytest.mark.parametrize("place", [0, -1], ids=["first", "last"])
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_first_and_last_cell_of_an_experiment_compose_and_build(paths, name, place):
    """The first at desk scale; the last at the papers', and of a mesh where it is of no dataset of its own."""
    cell, asked = cells(name)[place], [f"dataset.path={paths[name]}"] if name in paths else []
    if place:
        mesh = ["dataset=mesh", f"dataset.path={paths['mesh']}"]
        asked = ["scale=paper", *(asked if any(text.startswith("dataset=") for text in cell) else mesh)]
    config = composed(*cell, f"+experiment={name}", *asked)
    builds(config)
    assert config.experiment == (None if name in SINGLE else JOINED.get(name, name))
    for key, _, value in (text.removeprefix("+").partition("=") for text in cell):
        if key in ("renderer", "method"):
            if not place:
                brings_its_own(cell, config, key, value)
        elif key == "dataset":
            assert config.dataset.name == value
        elif key == "silhouette":
            assert config.task.silhouette == choice("silhouette", value)
        elif key != "stress":
            found, asked = OmegaConf.select(config, key), yaml.safe_load(value.replace(":", ": "))
            # Of a node, the rest of it stays.
            assert asked.items() <= dict(found).items() if isinstance(asked, dict) else found == type(found)(value)


def brings_its_own(cell: list[str], config: DictConfig, key: str, value: str) -> None:
    """Asserts that an experiment changes nothing that a renderer or a method sets."""
    default = composed()
    scaled = [f"scale.reconstruction.{name}" for name in ("iterations", "dvr_doublings")]  # schedules follow these
    sizes = [name for name in scaled if OmegaConf.select(config, name) != OmegaConf.select(default, name)]
    asked = [f"{name}={OmegaConf.select(config, name)}" for name in sizes]
    if "fit" in config.task:  # of a stress
        asked += [f"task.optimiser.iterations={config.task.fit.iterations}"]
    draw = [text for text in cell if text.startswith("draw=")]
    alone = composed(f"{'+' if key == 'method' else ''}{key}={value}", *draw, *asked)
    assert config.label == alone.label
    assert build_part(config, "renderer") == build_part(alone, "renderer")
    if key == "method":
        assert config.task._target_ == alone.task._target_
        own = choice("method", value).get("view")
        assert own is None or config.view.resolution == alone.view.resolution


def test_every_sweep_is_of_more_than_one_cell():
    assert {name for name in EXPERIMENTS if cells(name)[0] != cells(name)[1]} == {*EXPERIMENTS} - SINGLE


PAPER = DIST(  # DIST, Table 1, "+ coarse-to-fine": alpha 1.5 (Sec. 3.2) and nothing of ours
    steps=50, epsilon=5e-5, alpha=1.5, extra_step_cap=None, step_clamp=None, active_only=True, coarse_to_fine=True,
    careful_split=False,
    step_back=False, least_step=0.0, relaxation=0.0, slope_samples=0, n_gradient_samples=1, sphere_radius=1.0,
    silhouette_signed=False,
    silhouette_average="all",
)  # fmt: skip
FIRST = Naive(  # "Naive sphere tracing": ray by ray, with all steps in the graph
    steps=50, epsilon=5e-5, gradient="unrolled", n_gradient_samples=None, serial=True, sphere_radius=1.0,
    silhouette_signed=False, silhouette_average="all",
)  # fmt: skip
TABLE1 = {  # each row of the paper adds one thing to the row before
    "naive_serial": ("Naive sphere tracing", FIRST),
    "naive_practical": ("+ practical grad.", replace(FIRST, gradient="practical", n_gradient_samples=1)),
    "naive_practical_parallel": (
        "+ parallel",
        replace(FIRST, gradient="practical", n_gradient_samples=1, serial=False),
    ),
    "dist_dynamic": ("+ dynamic", replace(PAPER, alpha=1.0, coarse_to_fine=False)),
    "dist_aggressive": ("+ aggressive", replace(PAPER, coarse_to_fine=False)),
    "dist_coarse_to_fine": ("+ coarse-to-fine", PAPER),
    "dist_coarse_to_fine_100": ("+ coarse-to-fine, 100 steps", replace(PAPER, steps=100)),
}


@pytest.mark.parametrize("name", TABLE1)
def test_a_row_of_table_1_is_that_of_the_paper(compose_config, name):
    config = compose_config(f"renderer={name}")
    assert (config.renderer._label_, build_part(config, "renderer")) == TABLE1[name]


def test_table_1_begins_with_the_rows_of_the_paper():
    assert composed("+experiment=table1", hydra=True).hydra.sweeper.params.renderer.split(",")[:7] == [*TABLE1]


def test_variants_of_our_own_are_what_they_are_called(compose_config):
    def variant(name):
        config = compose_config(f"renderer={name}")
        return config.renderer._label_, build_part(config, "renderer")

    dist, dvr = variant("dist")[1], variant("dvr")[1]
    assert isinstance(dist, DIST) and isinstance(dvr, DVR)
    early, aggressive = replace(dvr, early_stop=True), replace(PAPER, coarse_to_fine=False)
    assert variant("naive_parallel") == ("Naive, all rays at once", replace(FIRST, serial=False))
    assert variant("dist_official_clamp") == ("DIST, official clamp", replace(PAPER, step_clamp=0.1))
    assert variant("dist_capped") == ("+ aggressive, capped", replace(aggressive, extra_step_cap=0.01))
    assert variant("dist_paper") == ("DIST, paper's", replace(PAPER, steps=100, n_gradient_samples=3))
    official = {
        "step_clamp": 0.1,
        "n_gradient_samples": 5,
        "silhouette_signed": True,
        "silhouette_average": "violating",
    }
    assert variant("dist_official") == ("DIST, official code's", replace(PAPER, steps=100, **official))
    assert variant("dvr_64") == ("DVR, n = 64", replace(dvr, n_ray_samples=64, doublings=(10, 30)))
    assert variant("dvr_official_slope") == ("DVR, official slope", replace(dvr, keep_slope_sign=False))
    assert variant("dvr_early_stop") == ("DVR, early stop", early)
    assert variant("dvr_fixed_16") == ("DVR, n = 16 fixed", replace(early, n_ray_samples=16, doublings=()))
    assert variant("dist_k_3") == ("DIST, K 3", replace(dist, n_gradient_samples=3))


def test_every_renderer_has_a_label_of_its_own_and_says_where_it_has_a_row():
    own = [choice("renderer", name) for name in names("renderer") if name != "custom"]
    labels = [node["_label_"] for node in own]
    assert len(set(labels)) == len(labels) >= 30
    places = [(experiment, place) for node in own for experiment, place in node["_rows_"].items()]
    assert len(set(places)) == len(places)
    assert {experiment for experiment, _ in places} == set(COMPARING)


@pytest.mark.parametrize("name", COMPARING)
def test_an_experiment_lists_the_renderers_that_name_it_in_the_order_of_their_places(name):
    rows = {renderer: choice("renderer", renderer).get("_rows_", {}) for renderer in names("renderer")}
    named = {renderer: places[name] for renderer, places in rows.items() if name in places}
    experiment = SHARED_ROWS.get(name, name)
    params = composed(f"+experiment={experiment}", hydra=True).hydra.sweeper.params
    assert params.renderer.split(",") == sorted(named, key=lambda renderer: named[renderer])
    assert len(named) == COMPARING[name]


@pytest.mark.parametrize("name", [name for name in EXPERIMENTS if not name.startswith("speed_")])  # a colour a class
def test_rows_of_an_experiment_are_told_apart_and_a_colour_is_of_one_class(name):
    params = composed(f"+experiment={name}", hydra=True).hydra.sweeper.get("params") or {}
    rows = str(params.get("+method") or params.get("renderer") or "dist").split(",")
    alike = [row for row in rows if not row.startswith("tuned/")]  # drawn as their methods, hollow
    assert len({(look(row).colour, look(row).marker) for row in alike}) == len(alike)
    classes = {(look(row).colour, class_of(row)) for row in alike}
    assert len({colour for colour, _ in classes}) == len(classes)


def class_of(row: str) -> str:
    """The class of a row's renderer; of a method without one, the method."""
    said = [row] if row in names("renderer") else renderers_of(row)
    return type(load("renderer", said[-1])).__name__ if said else row


def renderers_of(method: str) -> list[str]:
    """The renderers that a method chooses, that of its own last."""
    return [base["override /renderer"] for base in defaults_of(method) if "override /renderer" in base]


def test_a_row_that_conf_does_not_know_has_a_colour_of_no_renderer():
    known = {look(name).colour for name in visible("renderer") if name != "custom"}
    assert len(known) > 20 and not known & {*style._COLOURS}


@pytest.mark.parametrize("name", [*visible("method"), *(f"tuned/{name}" for name in visible("method/tuned"))])
def test_a_method_has_the_colour_of_its_renderer(name):
    renderers = renderers_of(name)
    assert not renderers or look(name).colour == look(renderers[-1]).colour


def defaults_of(method: str) -> list[Any]:
    """The `defaults` of a method, those of what it builds on before its own."""
    own = choice("method", method).get("defaults", [])
    bases = [base.removeprefix("/method/") for base in own if isinstance(base, str) and base != "_self_"]
    return [each for base in bases for each in defaults_of(base)] + own


def test_a_chosen_method_brings_its_own_renderer_into_an_experiment_of_renderers():
    params = composed("+experiment=speed_completion", "+method=dist_half", hydra=True).hydra.sweeper.params
    assert params.renderer == "dist"


def test_measuring_experiments_measure_the_shape_that_their_network_was_fitted_to(compose_config):
    for name in ("table1", "fig4", "fig7", "gradients"):
        for scale, size in (("smoke", 64), ("desk", 256), ("paper", 512)):
            config = compose_config(f"+experiment={name}", f"scale={scale}")
            prior = build_part(config, "prior")
            assert (prior.shapes, config.split, config.index, config.view.resolution) == (1, "train", 0, size)
            network = prior.network
            assert (network.layers, network.width, network.code_length, network.skip) == (8, 512, 256, 4)  # DIST, B.1


def test_figure_7_is_of_the_papers_setting_over_epsilon(compose_config):
    config = compose_config("+experiment=fig7", "renderer.epsilon=5e-3")
    assert build_part(config, "renderer") == replace(PAPER, epsilon=5e-3)
    assert config.label == "epsilon 0.005"


def test_figure_5_looks_at_the_chamfer_distance_on_the_way(compose_config):
    config = compose_config("+experiment=fig5", "renderer=idr")
    assert (config.evaluation.every, config.task.points) == (20, "dense")
    assert compose_config().evaluation.every == "doubling"


def test_a_label_may_be_given(compose_config):
    assert compose_config("label=my row").label == "my row"
    assert (compose_config().label, compose_config().experiment) == (None, None)


@pytest.mark.parametrize(
    ("overrides", "iterations"),
    [
        (["task=completion", "task.optimiser.iterations=37"], 37),
        (["task=stability", "stress=depth_noise", "task.fit.iterations=38"], 38),
        (["task=single_view", "task.training.steps=39"], 39),
        (["task=ablation"], 100),
    ],
)
@pytest.mark.parametrize("renderer", ["neus", "volsdf", "volsdf_budget", "unisurf"])
def test_a_volume_is_sharp_at_the_end_of_whatever_it_optimises(compose_config, renderer, overrides, iterations):
    assert compose_config(f"renderer={renderer}", *overrides).renderer.sharpening == iterations


def test_the_practical_gradient_of_naive_asks_for_its_number_of_samples(compose_config):
    practical = ("renderer=naive", "renderer.gradient=practical")
    with pytest.raises(
        ValueError, match="n_gradient_samples must be given for gradient=practical: n_gradient_samples=1"
    ):
        build_part(compose_config(*practical), "renderer")
    assert build_part(compose_config(*practical, "renderer.n_gradient_samples=2"), "renderer").n_gradient_samples == 2


@pytest.mark.parametrize("name", ["dist", "dvr_64_early_stop", "neus_budget", "custom"])
def test_a_renderer_loads_as_a_library_with_its_arguments_changed(compose_config, name):
    known = [field.name for field in fields(load("renderer", name))] if name != "custom" else ["steps"]
    number = next(one for one in ("steps", "n_ray_samples", "samples", "grid", "most_segments") if one in known)
    given = {"_target_": "renderers.IDR", **IDR_ARGUMENTS} if name == "custom" else {number: 7}
    extra = CUSTOM if name == "custom" else [f"renderer.{number}=7"]
    found = load("renderer", name, **given)
    assert found == build_part(compose_config(f"renderer={name}", *extra), "renderer")
    assert getattr(found, number) == 7


def test_a_renderer_of_ones_own_needs_its_class_only(compose_config, tmp_path, monkeypatch):
    (tmp_path / "mypkg_of_mine.py").write_text(
        "class Mine:\n    def __init__(self, size=1):\n        self.size = size\n"
        "    def render(self, field, rays): ...\n"
        "    def silhouette_loss(self, field, rays, rendering, mask): ...\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=r"renderer\._target_ must be given: set renderer\._target_=PACKAGE\.CLASS"):
        build_part(compose_config("renderer=custom"), "renderer")
    with pytest.raises(ValueError, match=r"renderer\._target_ must be given"):
        load("renderer", "custom")
    with pytest.raises(ValueError, match=r"names 'mypkg_of_mine\.Yours', which cannot be imported"):
        build_part(compose_config("renderer=custom", "renderer._target_=mypkg_of_mine.Yours"), "renderer")
    config = compose_config("renderer=custom", "renderer._target_=mypkg_of_mine.Mine", "+renderer.size=3")
    made, loaded = build_part(config, "renderer"), load("renderer", "custom", _target_="mypkg_of_mine.Mine", size=3)
    assert (type(made).__name__, made.size) == (type(loaded).__name__, loaded.size) == ("Mine", 3)
    with pytest.raises(ValueError, match="renderer has no key 'sise': did you mean size"):
        load("renderer", "custom", _target_="mypkg_of_mine.Mine", sise=3)
    with pytest.raises(ValueError, match=r"dataset\._target_ names 'mypkg_of_mine\.Mine': add its package"):
        other = compose_config(  # leave for the renderer is not leave for all
            "renderer=custom", "renderer._target_=mypkg_of_mine.Mine", "dataset._target_=mypkg_of_mine.Mine"
        )
        build_part(other, "dataset")


def test_a_variant_loads_as_a_library_with_what_it_builds_on():
    assert load("renderer", "dist_coarse_to_fine") == PAPER
    assert load("renderer", "naive_practical_parallel", steps=7) == replace(
        FIRST, gradient="practical", n_gradient_samples=1, serial=False, steps=7)  # fmt: skip
    with pytest.raises(ValueError, match=r"renderer has no key 'samples': did you mean .*n_gradient_samples"):
        load("renderer", "dist_aggressive", samples=3)


def test_loading_tells_of_mistakes():
    with pytest.raises(ValueError, match="unknown renderer 'dits': did you mean dist"):
        load("renderer", "dits")
    with pytest.raises(ValueError, match="renderer has no key 'step': did you mean steps"):
        load("renderer", "dist", step=7)


def test_a_dataset_of_meshes_asks_for_its_path(compose_config):
    with pytest.raises(ValueError, match=r"dataset\.path must be given: set dataset\.path="):
        build_part(compose_config("dataset=mesh"), "dataset")


@pytest.mark.parametrize(
    ("part", "override", "message"),
    [
        ("renderer", "+renderer.stepz=3", r"renderer has no key 'stepz': did you mean steps"),
        ("renderer", "+renderer.epsilom=1", r"renderer has no key 'epsilom': did you mean epsilon"),
        ("task", "+task.silhouete_weight=1", r"task has no key 'silhouete_weight': did you mean silhouette_weight"),
        ("dataset", "+dataset.resolutions=1", r"dataset has no key 'resolutions': did you mean resolution"),
        ("prior", "+scale.network.widht=1", r"prior\.network has no key 'widht': did you mean width"),
        ("renderer", "+renderer.xyzzy=1", r"renderer has no key 'xyzzy': it has active_only, alpha, .*steps"),
    ],
)
def test_an_unknown_key_is_told_with_the_nearest(compose_config, part, override, message):
    with pytest.raises(ValueError, match=message):
        build_part(compose_config(override), part)


@pytest.mark.parametrize(
    ("part", "override", "message"),
    [
        ("renderer", "renderer.steps=many", r"renderer\.steps: .*'many'.*expected int"),
        ("renderer", "renderer.steps=1.5", r"renderer\.steps: .*expected int"),
        ("renderer", "renderer.alpha=[1]", r"renderer\.alpha: .*expected float"),
        ("renderer", "renderer.epsilon=null", r"renderer\.epsilon: .*expected float"),
        ("renderer", "renderer.active_only=perhaps", r"renderer\.active_only: .*expected bool"),
        ("renderer", "renderer.extra_step_cap=wide", r"renderer\.extra_step_cap: .*expected float \| None"),
        ("dataset", "dataset.ranges=7", r"dataset\.ranges: .*expected dict"),
        ("prior", "scale.network.width=wide", r"prior\.network\.width: .*expected int"),
    ],
)
def test_a_value_of_the_wrong_type_is_told_with_its_key(compose_config, part, override, message):
    with pytest.raises(ValueError, match=message):
        build_part(compose_config(override), part)


@pytest.mark.parametrize(
    ("part", "override", "message"),
    [
        ("renderer", "renderer.steps=0", "steps must be at least 1, not 0"),
        ("renderer", "renderer.alpha=0.5", "alpha must be at least 1, not 0.5"),
        ("renderer", "renderer.epsilon=0", "epsilon must be positive, not 0"),
        ("renderer", "renderer.epsilon=nan", "epsilon must be positive, not nan"),
        ("renderer", "renderer.n_gradient_samples=0", "n_gradient_samples must be at least 1, not 0"),
        ("renderer", "renderer.step_clamp=-1", "step_clamp must be positive, not -1.0: step_clamp=null"),
        ("renderer", "renderer.sphere_radius=-1", "sphere_radius must be positive"),
        ("renderer", "renderer.silhouette_average=some", "silhouette_average must be one of all, violating"),
        ("task", "task.code.average=median", "task.code.average must be one of sum, mean, not 'median'"),
        ("dataset", "dataset.resolution=1", "resolution must be at least 16, not 1"),
    ],
)  # fmt: skip
def test_a_value_out_of_range_is_told_with_the_remedy(compose_config, part, override, message):
    with pytest.raises(ValueError, match=message):
        build_part(compose_config(override), part)


def test_a_setting_within_another_says_where_it_stands(compose_config):
    with pytest.raises(ValueError, match=r"^task\.images: noise must be at least 0, not -1"):
        build_part(compose_config("task=multiview", "task.images.noise=-1"), "task")


def test_naive_checks_its_numbers_as_dist_does(compose_config):
    for override in ("steps=0", "epsilon=0", "sphere_radius=0", "silhouette_average=some"):
        with pytest.raises(ValueError, match=override.split("=")[0]):
            build_part(compose_config("renderer=naive", f"renderer.{override}"), "renderer")


def test_a_target_outside_our_packages_needs_leave(compose_config):
    config = compose_config("renderer._target_=os.system")
    with pytest.raises(ValueError, match=r"renderer\._target_ names 'os\.system': os is of Python's standard library"):
        build_part(config, "renderer")
    for target in ("renderers.DISTT", "renderers.nowhere.DIST"):
        with pytest.raises(ValueError, match=rf"renderer\._target_ names '{target}', which cannot be imported"):
            build_part(compose_config(f"renderer._target_={target}"), "renderer")


def test_a_mask_loss_is_refused_where_no_task_reads_it(compose_config):
    with pytest.raises(
        ValueError, match=r"silhouette is read by task=completion, .*reconstruction and single_view alone"
    ):
        check_names(compose_config("task=gradients", "silhouette=hinge"))
    for task in ("completion", "pose", "capacity", "stability", "gradients"):
        check_names(compose_config(f"task={task}", f"silhouette={'own' if task == 'gradients' else 'hinge'}"))


def test_a_draw_is_refused_where_no_setting_is_drawn(compose_config):
    with pytest.raises(ValueError, match=r"draw is read by a method of method/space alone: add \+method=space/NAME"):
        check_draw(compose_config("renderer=dist", "draw=3"))
    check_draw(compose_config("+method=space/dist_mask", "draw=3"))


def test_a_name_of_a_folder_is_compared_with_the_names_there():
    known = ["dist_mask", "tuned/dist_mask", "tuned/idr_mask", "space/dist_mask"]
    assert nearest("tuned/dist_masc", known).startswith(": did you mean tuned/dist_mask")
    assert "did you mean dist_mask" in nearest("dist_masc", known)


def test_a_mask_loss_is_a_file_and_no_name(compose_config):
    with pytest.raises(ValueError, match=r"task\.silhouette must have a _target_, not be 'hinge'"):
        build(compose_config("task.silhouette=hinge").task, "task")
