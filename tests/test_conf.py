"""Every YAML in conf composes and builds; a mistake in one is told with its key and the nearest right one."""

import pytest
import trimesh
from omegaconf import DictConfig, OmegaConf

from bench.config import CONF, build, load
from bench.tasks.problem import Task
from datasets.dataset import Dataset
from renderers import DIST
from renderers.rendering import Renderer

YAMLS = sorted((path.parent.name, path.stem) for path in CONF.glob("*/*.yaml"))
GROUPS = [(group, name) for group, name in YAMLS if group != "experiment"]
EXPERIMENTS = [name for group, name in YAMLS if group == "experiment"]
KINDS = {"renderer": Renderer, "task": Task, "dataset": Dataset}
TARGETS = {"prior": "bench.autodecoder.PriorSettings"}  # nodes whose class the code knows
PARTS = ("task", "renderer", "dataset", "prior")


@pytest.fixture
def mesh_path(tmp_path) -> str:
    path = tmp_path / "ball.ply"
    trimesh.creation.icosphere(subdivisions=2).export(path)
    return str(path)


def build_part(config: DictConfig, part: str):
    return build(config[part], part, list(config.packages), TARGETS.get(part, ""))


def test_no_yaml_lies_where_it_is_not_looked_for():
    assert {path.relative_to(CONF) for path in CONF.rglob("*.yaml")} == {
        path.relative_to(CONF) for path in (*CONF.glob("*.yaml"), *CONF.glob("*/*.yaml"))
    }
    assert [path.name for path in CONF.glob("*.yaml")] == ["config.yaml"]
    assert {group for group, _ in YAMLS} == {"task", "renderer", "dataset", "prior", "scale", "experiment"}


def test_the_default_configuration_builds(compose_config):
    config = compose_config()
    for part in PARTS:
        build_part(config, part)
    build(config.view, "view", target="datasets.views.ViewSampler")
    build(config.evaluation, "evaluation", target="bench.config.EvaluationSettings")


@pytest.mark.parametrize(("group", "name"), GROUPS)
def test_every_choice_composes_and_builds(compose_config, mesh_path, group, name):
    extra = [f"dataset.path={mesh_path}"] if (group, name) == ("dataset", "mesh") else []
    config = compose_config(f"{group}={name}", *extra)
    OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    for part in PARTS:  # a scale is read by the others
        build_part(config, part)
    build(config.view, "view", target="datasets.views.ViewSampler")
    if group in KINDS:
        assert isinstance(build_part(config, group), KINDS[group])


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_composes_and_builds(compose_config, name):
    config = compose_config(f"+experiment={name}")
    OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    for part in PARTS:
        build_part(config, part)


def test_the_paper_experiment_has_the_papers_settings(compose_config):
    # DIST: 50 to 100 steps, alpha 1.5 without a cap, epsilon 5e-5 (Secs. 3.2, A.1); Eq. 11 has no sign, over all rays.
    renderer = build_part(compose_config("+experiment=completion_paper"), "renderer")
    assert renderer == DIST(
        steps=100, epsilon=5e-5, alpha=1.5, extra_step_cap=None, step_clamp=None, active_only=True,
        coarse_to_fine=True, careful_split=False, samples=3, sphere_radius=1.0, silhouette_signed=False,
        silhouette_average="all",
    )  # fmt: skip


def test_the_samples_of_a_renderer_are_those_of_the_task_unless_set(compose_config):
    assert build_part(compose_config("task.samples=4"), "renderer").samples == 4
    assert build_part(compose_config("task.samples=4", "renderer.samples=2"), "renderer").samples == 2


@pytest.mark.parametrize("name", [name for group, name in GROUPS if group == "renderer"])
def test_a_renderer_loads_as_a_library_with_its_arguments_changed(compose_config, name):
    assert load("renderer", name, steps=7) == build_part(
        compose_config(f"renderer={name}", "renderer.steps=7"), "renderer"
    )


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
        ("task", "+task.learning_rat=1", r"task has no key 'learning_rat': did you mean learning_rate"),
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
        ("renderer", "renderer.samples=0", "samples must be at least 1, not 0"),
        ("renderer", "renderer.step_clamp=-1", "step_clamp must be positive, not -1.0: step_clamp=null"),
        ("renderer", "renderer.sphere_radius=-1", "sphere_radius must be positive"),
        ("renderer", "renderer.silhouette_average=some", "silhouette_average must be one of all, violating"),
        ("task", "task.code_average=median", "task.code_average must be one of sum, mean, not 'median'"),
        ("dataset", "dataset.resolution=1", "resolution must be at least 16, not 1"),
    ],
)  # fmt: skip
def test_a_value_out_of_range_is_told_with_the_remedy(compose_config, part, override, message):
    with pytest.raises(ValueError, match=message):
        build_part(compose_config(override), part)


def test_naive_checks_its_numbers_as_dist_does(compose_config):
    for override in ("steps=0", "epsilon=0", "sphere_radius=0", "silhouette_average=some"):
        with pytest.raises(ValueError, match=override.split("=")[0]):
            build_part(compose_config("renderer=naive", f"renderer.{override}"), "renderer")


def test_a_target_outside_our_packages_needs_leave(compose_config):
    config = compose_config("renderer._target_=os.system")
    with pytest.raises(ValueError, match=r"renderer\._target_ names 'os\.system': add its package by packages=\[os\]"):
        build_part(config, "renderer")
    for target in ("renderers.DISTT", "renderers.nowhere.DIST"):
        with pytest.raises(ValueError, match=rf"renderer\._target_ names '{target}', which cannot be imported"):
            build_part(compose_config(f"renderer._target_={target}"), "renderer")
