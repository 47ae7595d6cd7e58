"""Every YAML in conf composes and builds; the message on a mistake has its key and the nearest valid key.

Cells of experiments: tests/conf/test_cells.py.
"""

from dataclasses import is_dataclass, replace
from functools import cache
from inspect import signature
from typing import Any

import pytest
import trimesh
from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf

from bench.config import build, check_references, class_of_node, load
from bench.pictures import figure_style
from bench.pictures.figure_style import look
from bench.setup.inputs import Task
from bench.tables import CONF, GROUP_OF_TABLE, choice, extension, extensions, names, read_yaml
from datasets.scene import Dataset
from renderers import DIST, Naive
from renderers.rendering import Renderer
from renderers.silhouette import SilhouetteLoss
from tests.composing import composed
from tests.conf.test_rows import CLASS
from tests.datasets.test_shapenet import write_shapenet
from tests.looped import each
from tests.made_scans import write_scans

IDR_ARGUMENTS = {"steps": 7, "epsilon": 1e-4, "least_slope": 1e-3, "mask_sharpness": 50.0, "mask_weight": 100.0}
IDR_ARGUMENTS["sphere_radius"] = 1.0
KINDS = {"renderer": Renderer, "task": Task, "dataset": Dataset, "silhouette": SilhouetteLoss}
PARTS = ("task", "renderer", "dataset", "prior", "silhouette")
LINEAR = ["packages=[torch]", "dataset.module._target_=torch.nn.Linear"]
LINEAR += ["+dataset.module={in_features:3,out_features:1}"]
CUSTOM = ("renderer._target_=renderers.IDR", *(f"+renderer.{k}={v}" for k, v in IDR_ARGUMENTS.items()))


def visible(group: str) -> list[str]:
    """The choices of a group, without those that are only bases of others."""
    return [name for name in names(group) if not name.startswith("_")]


def together() -> list[dict[str, str]]:
    """Combinations of choices of all groups, in which each choice occurs; a composition takes 0.1 seconds."""
    stresses, tasks = visible("stress"), [name for name in visible("task") if name != "stability"]
    stresses.remove("none")
    judged = [("stability", stress) for stress in stresses] + [(task, "none") for task in tasks]
    columns = {group: visible(group) for group in names_of_groups() if group not in ("task", "stress")}
    count = max(len(judged), *map(len, columns.values()))
    rows = [{group: column[n % len(column)] for group, column in columns.items()} for n in range(count)]
    return [row | dict(zip(("task", "stress"), judged[n % len(judged)], strict=True)) for n, row in enumerate(rows)]


def names_of_groups() -> tuple[str, ...]:
    return ("task", "renderer", "dataset", "silhouette", "stress", "supervision", "prior", "scale", "tracker")


TOGETHER = together()
METHODS = [*visible("method"), *(f"tuned/{name}" for name in visible("method/tuned"))]  # spaces: test_spaces
SLOW = pytest.mark.slow  # a composition takes a tenth of a second
SOME_METHODS = [name if index % 16 == 0 else pytest.param(name, marks=SLOW) for index, name in enumerate(METHODS)]


@pytest.fixture(scope="session")
def paths(tmp_path_factory) -> dict[str, str]:
    """The `dataset.path` that each dataset of files needs."""
    mesh, scans = tmp_path_factory.mktemp("mesh") / "box.obj", tmp_path_factory.mktemp("scans")
    trimesh.creation.box().export(mesh)
    unread = dict.fromkeys(("photos", "network", "module"), str(mesh.parent))  # building it reads no content
    unread["depth_image"] = str(mesh)
    paths_by_dataset = unread | {"mesh": str(mesh), "scans": str(write_scans(scans))}
    return paths_by_dataset | {"shapenet": str(write_shapenet(tmp_path_factory.mktemp("shapenet")))}


def build_part(config: DictConfig, node: str):
    return build(config[node], node, list(config.packages), class_of_node(node))


def test_every_yaml_is_in_a_folder_that_is_searched():
    assert {path.stem for path in CONF.glob("*.yaml")} == {
        "config",
        "extensions",
        "suite",
        "published",
        *GROUP_OF_TABLE,
    }
    folders = {path.parent.relative_to(CONF).as_posix() for path in CONF.rglob("*.yaml")} - {"."}
    files = {"task", "renderer", "dataset", "prior", "scale", "tracker", "experiment", "effort", "hydra/launcher"}
    assert folders <= files | {*GROUP_OF_TABLE.values(), "method/space", "external"}


def test_extensions_exist():
    assert all(callable(extension(purpose)) for purpose in extensions())


def test_no_yaml_sets_the_mode_of_hydra():
    assert composed(hydra=True).hydra.mode is None
    for path in CONF.rglob("*.yaml"):
        assert "mode" not in (read_yaml(path).get("hydra") or {}), path


@pytest.mark.parametrize("table", GROUP_OF_TABLE)
def test_a_table_has_no_row_twice_and_no_text_that_should_be_a_number(table):
    """A YAML reader reports neither: it takes the last of two rows, and reads 1e-3 as text."""
    strict = OmegaConf.to_container(OmegaConf.load(CONF / f"{table}.yaml"), resolve=False)
    assert strict == read_yaml(CONF / f"{table}.yaml")
    assert not {path.stem for path in (CONF / GROUP_OF_TABLE[table]).glob("*.yaml")} & {*strict}


def builds(config: DictConfig) -> None:
    """Asserts that all of a configuration resolves, and that its nodes build objects of their kinds."""
    OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    built = {node: build_part(config, node) for node in PARTS}  # other nodes read the scale
    assert all(isinstance(built[node], kind) for node, kind in KINDS.items())
    build(config.view, "view", target="datasets.views.ViewSampler")


def test_every_choice_is_in_a_composition():
    for group in names_of_groups():
        assert {row[group] for row in TOGETHER} == {*visible(group)}
    assert len(METHODS) > 60 and len({row["renderer"] for row in TOGETHER}) > 50


@pytest.mark.parametrize("row", TOGETHER, ids=lambda row: " ".join(row.values()))
def test_every_choice_composes_and_builds(paths, row):
    needed = [f"dataset.path={path}" for name, path in paths.items() if name == row["dataset"]]
    needed += CUSTOM if row["renderer"] == "custom" else ()
    needed += LINEAR if row["dataset"] == "module" else []
    needed += ["dataset.intrinsics=[9,9,4,4]"] if row["dataset"] == "depth_image" else []
    needed += [f"prior.path={paths['network']}"] if row["prior"] == "deepsdf" else []
    config = composed(*(f"{group}={name}" for group, name in row.items()), *needed)
    builds(config)
    if row["stress"] != "none":
        assert build_part(config, "task").stress.scene == choice("stress", row["stress"])["scene"]
    renderer = build_part(config, "renderer")
    if row["renderer"] != "custom":
        alone = load("renderer", row["renderer"])
        steps = {name: getattr(renderer, name) for name in ("sharpening",) if hasattr(renderer, name)}  # from the task
        assert replace(alone, **steps) == renderer
    assert load("silhouette", row["silhouette"]) == build_part(config, "silhouette")


@cache
def merged(group: str, name: str) -> dict[str, Any]:
    """The content of a file or a row, over that of its bases."""
    content, node = choice(group, name), dict[str, Any]()
    for base in content.get("defaults", ()):
        if isinstance(base, str) and base != "_self_":
            node = over(node, merged(group, base.removeprefix(f"/{group}/")))
    return over(node, content)


def over(node: dict[str, Any], content: dict[str, Any]) -> dict[str, Any]:
    """Content over that of a node, key by key."""
    both = {key for key in {*node} & {*content} if isinstance(node[key], dict) and isinstance(content[key], dict)}
    return node | content | {key: over(node[key], content[key]) for key in both}


def inherited(name: str, group: str) -> dict[str, Any]:
    """The content of the file or row of a group that a method chooses, or else that it has from its base or default."""
    defaults, key = choice("method", name).get("defaults", ()), f"override /{group}"
    for default in (default for default in defaults if isinstance(default, dict) and key in default):
        return merged(group, default[key])
    if isinstance(base := next(iter(defaults), None), str) and base != "_self_":
        base = base.removeprefix("/method/")
        return over(inherited(base, group), choice("method", base).get(group, {}))
    return merged(group, composed(hydra=True).hydra.runtime.choices[group])


def lacking(node: dict[str, Any], known: dict[str, Any]) -> list[str]:
    """The keys of a node that another node lacks, also of nodes within them."""
    nested = [(child, known[key]) for key, child in node.items() if key in known]
    pairs = [pair for pair in nested if isinstance(pair[0], dict) and isinstance(pair[1], dict)]
    return [*({*node} - {*known}), *(key for pair in pairs for key in lacking(*pair))]


@each("name", METHODS)
@each("group", ["task", "renderer"])
def test_a_key_of_a_method_is_one_of_the_task_and_the_renderer_that_it_chooses(name, group):
    known = inherited(name, group)
    target = known["_target_"].rpartition(",")[2].rstrip("}")  # perhaps the default of a reference
    parameters = signature(get_class(target)).parameters
    known = dict.fromkeys(parameters) | known
    for key in (key for key in {*known} & {*parameters} if is_dataclass(parameters[key].annotation)):
        if isinstance(known[key], dict):
            known[key] = dict.fromkeys(signature(parameters[key].annotation).parameters) | known[key]
    assert lacking(choice("method", name).get(group, {}), known) == []


@pytest.mark.parametrize("name", SOME_METHODS)
def test_every_method_composes_and_builds(name):
    cloud = ["task.cloud=points.ply"] if name.startswith("cloud") else []  # the row contains the file's name
    builds(composed(f"+method={name}", *cloud))


PAPER = DIST(  # DIST, Table 1, "+ coarse-to-fine": alpha 1.5 (Sec. 3.2), the official code's clamp, no changes of ours
    steps=50, epsilon=5e-5, alpha=1.5, extra_step_cap=None, step_clamp=0.1, active_only=True, coarse_to_fine=True,
    careful_split=False, step_back=False, least_step=0.0, relaxation=0.0, slope_samples=0, n_gradient_samples=1,
    sphere_radius=1.0, silhouette_signed=False, silhouette_average="all",
)  # fmt: skip
NAIVE = Naive(  # "Naive sphere tracing": ray by ray, with all steps in the graph
    steps=50, epsilon=5e-5, gradient="unrolled", n_gradient_samples=None, serial=True, sphere_radius=1.0,
    silhouette_signed=False, silhouette_average="all",
)  # fmt: skip
PARALLEL = replace(NAIVE, gradient="practical", n_gradient_samples=1, serial=False)
TABLE1 = {  # each row of the paper adds one thing to the row before
    "naive_serial": ("Naive sphere tracing", NAIVE),
    "naive_practical": ("+ practical grad.", replace(NAIVE, gradient="practical", n_gradient_samples=1)),
    "naive_practical_parallel": ("+ parallel", PARALLEL),
    "dist_dynamic": ("+ dynamic", replace(PAPER, alpha=1.0, coarse_to_fine=False)),
    "dist_aggressive": ("+ aggressive", replace(PAPER, coarse_to_fine=False)),
    "dist_coarse_to_fine": ("+ coarse-to-fine", PAPER),
    "dist_coarse_to_fine_100": ("+ coarse-to-fine, 100 steps", replace(PAPER, steps=100)),
}


def test_table_1_begins_with_the_rows_of_the_paper():
    for name, row in TABLE1.items():
        config = composed(f"renderer={name}")
        assert (config.renderer._label_, build_part(config, "renderer")) == row
    assert composed("+experiment=table1", hydra=True).hydra.sweeper.params.renderer.split(",")[:7] == [*TABLE1]


def test_variants_have_the_settings_of_their_names():
    dist, dvr = load("renderer", "dist"), load("renderer", "dvr")
    early, unclamped = replace(dvr, early_stop=True), replace(PAPER, coarse_to_fine=False, step_clamp=None)
    official = {"silhouette_signed": True, "silhouette_average": "missed_plus_spurious"}
    for name, wanted in {
        "naive_parallel": replace(NAIVE, serial=False),
        "dist_aggressive_unclamped": unclamped,
        "dist_unclamped": replace(PAPER, step_clamp=None),
        "dist_capped": replace(unclamped, extra_step_cap=0.01),
        "dist_paper": replace(PAPER, steps=100, n_gradient_samples=3),
        "dist_official": replace(PAPER, steps=100, n_gradient_samples=3, **official),
        "dvr_64": replace(dvr, n_ray_samples=64, doublings=(10, 30)),
        "dvr_early_stop": early,
        "dvr_fixed_16": replace(early, n_ray_samples=16, doublings=()),
        "dist_k_3": replace(dist, n_gradient_samples=3),
    }.items():
        assert load("renderer", name) == wanted, name


def test_every_renderer_has_its_own_label_and_names_its_rows():
    nodes = [choice("renderer", name) for name in names("renderer") if name != "custom"]
    labels = [node["_label_"] for node in nodes]
    assert len(set(labels)) == len(labels) >= 30
    ranks = [(experiment, rank) for node in nodes for experiment, rank in node["_rows_"].items()]
    assert len(set(ranks)) == len(ranks) and len({experiment for experiment, _ in ranks}) == 8


def label_of(group: str, name: str) -> str:
    """The name of a method or a renderer in tables, perhaps inherited from its base; empty without one."""
    settings = choice(group, name)
    bases = [base for base in settings.get("defaults", ()) if isinstance(base, str) and base != "_self_"]
    inherited = [label_of(group, base.removeprefix(f"/{group}/")) for base in bases]
    return settings.get("label") or settings.get("_label_") or next(filter(None, inherited), "")


def test_rows_of_one_label_have_one_look():
    looks: dict[str, set[figure_style.Look]] = {}
    for group in ("method", "renderer"):
        for name in names(group):
            looks.setdefault(label_of(group, name) or name, set()).add(look(name))
    assert {label: label_looks for label, label_looks in looks.items() if len(label_looks) > 1} == {}


def test_an_unknown_row_has_a_colour_of_no_renderer():
    classes = {name: type(load("renderer", name)) for name in visible("renderer") if name != "custom"}
    class_colours = {(look(name).colour, cls) for name, cls in classes.items()}
    colours = {colour for colour, _ in class_colours}
    assert len(class_colours) == len(colours) > 20  # each colour has one class
    assert not colours & {*figure_style.FALLBACK_COLOURS}


def test_a_chosen_method_brings_its_own_renderer_into_an_experiment_of_renderers():
    params = composed("+experiment=speed_completion", "+method=dist_half", hydra=True).hydra.sweeper.params
    assert params.renderer == "dist"


@each("overrides, iterations", [
    (["task=completion", "task.optimiser.iterations=37", "renderer=neus"], 37),
    (["task=stability", "stress=depth_noise", "task.fit.iterations=38", "renderer=volsdf"], 38),
    (["task=single_view", "task.training.steps=39", "renderer=volsdf_budget"], 39),
    (["task=ablation", "renderer=unisurf"], 100),
])  # fmt: skip
def test_a_volume_is_sharp_at_the_end_of_each_kind_of_optimisation(compose_config, overrides, iterations):
    assert compose_config(*overrides).renderer.sharpening == iterations


def test_the_practical_gradient_of_naive_asks_for_its_number_of_samples(compose_config):
    practical = ("renderer=naive", "renderer.gradient=practical")
    with pytest.raises(ValueError, match=r"n_gradient_samples must be given .*: n_gradient_samples=1"):
        build_part(compose_config(*practical), "renderer")
    assert build_part(compose_config(*practical, "renderer.n_gradient_samples=2"), "renderer").n_gradient_samples == 2


FAULTY_CLASSES = """
import abc, dataclasses

class Abstract(Mine, abc.ABC):
    @abc.abstractmethod
    def render(self, field, rays): ...

@dataclasses.dataclass
class TwoSettings(Mine):
    size: int
    more: float
"""


def test_a_user_renderer_needs_only_its_class(compose_config, tmp_path, monkeypatch):
    (tmp_path / "mypkg_of_mine.py").write_text(CLASS + FAULTY_CLASSES)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=r"renderer\._target_ must be given"):
        load("renderer", "custom")
    with pytest.raises(ValueError, match=r"names 'mypkg_of_mine\.Yours', which cannot be imported"):
        build_part(compose_config("renderer=custom", "renderer._target_=mypkg_of_mine.Yours"), "renderer")
    with pytest.raises(ValueError, match="No module named 'no_such_package'; add its folder to PYTHONPATH"):
        load("renderer", "custom", _target_="no_such_package.Mine")
    with pytest.raises(ValueError, match=r"size and renderer\.more must be .*: set \+renderer\.size=.* \+renderer\."):
        load("renderer", "custom", _target_="mypkg_of_mine.TwoSettings")
    with pytest.raises(ValueError, match="it does not define render: see renderers"):
        load("renderer", "custom", _target_="mypkg_of_mine.Abstract")
    config = compose_config("renderer=custom", "renderer._target_=mypkg_of_mine.Mine", "+renderer.size=3")
    built, loaded = build_part(config, "renderer"), load("renderer", "custom", _target_="mypkg_of_mine.Mine", size=3)
    assert (type(built).__name__, built.size) == (type(loaded).__name__, loaded.size) == ("Mine", 3)
    with pytest.raises(ValueError, match="renderer has no key 'sise': did you mean size"):
        load("renderer", "custom", _target_="mypkg_of_mine.Mine", sise=3)
    with pytest.raises(ValueError, match=r"dataset\._target_ names 'mypkg_of_mine\.Mine': type packages="):
        build({"_target_": "mypkg_of_mine.Mine"}, "dataset")  # only a renderer's class names its package


def test_a_choice_loads_from_python_with_its_base_and_reports_mistakes():
    assert load("renderer", "dist_coarse_to_fine") == PAPER
    assert load("renderer", "naive_practical_parallel", steps=7) == replace(PARALLEL, steps=7)
    with pytest.raises(ValueError, match="unknown renderer 'dits': did you mean dist"):
        load("renderer", "dits")
    with pytest.raises(ValueError, match=r"renderer has no key 'samples': did you mean .*n_gradient_samples"):
        load("renderer", "dist_aggressive", samples=3)


@each("node, override, message", [
    ("renderer", "+renderer.epsilom=1", r"renderer has no key 'epsilom': did you mean epsilon"),
    ("prior", "+scale.network.widht=1", r"prior\.network has no key 'widht': did you mean width"),
    ("renderer", "+renderer.xyzzy=1", r"renderer has no key 'xyzzy': it has active_only, alpha, .*steps"),
    ("renderer", "renderer.steps=1.5", r"renderer\.steps must be a whole number, not 1\.5"),
    ("renderer", "renderer.epsilon=null", r"renderer\.epsilon must be a number, not None"),
    ("renderer", "renderer.active_only=perhaps", r"renderer\.active_only must be true or false, not 'perhaps'"),
    ("renderer", "renderer.extra_step_cap=wide", r"renderer\.extra_step_cap must be a number or null, not 'wide'"),
    ("dataset", "dataset.ranges=7", r"dataset\.ranges must be keys and values, not 7"),
    ("prior", "scale.network.width=wide", r"prior\.network\.width must be a whole number, not 'wide'"),
    ("task", "task.code.average=median", r"task\.code\.average must be one of sum, mean, not 'median'"),
    ("task", "task.silhouette=hinge", r"task\.silhouette must have a _target_, not be 'hinge'"),
])  # fmt: skip
def test_a_wrong_key_or_value_is_an_error_with_the_remedy(compose_config, node, override, message):
    with pytest.raises(ValueError, match=message):
        build_part(compose_config(override), node)


def test_the_message_on_a_nested_setting_names_its_path(compose_config):
    with pytest.raises(ValueError, match=r"^task\.images: noise must be at least 0, not -1"):
        build_part(compose_config("task=multiview", "task.images.noise=-1"), "task")


def test_a_silhouette_loss_is_refused_if_the_task_does_not_read_it(compose_config):
    with pytest.raises(ValueError, match=r"silhouette is read only by task=capacity, .*single_view, stability"):
        check_references(compose_config("task=gradients", "silhouette=hinge"))
    for task in ("completion", "stability", "gradients"):
        check_references(compose_config(f"task={task}", f"silhouette={'own' if task == 'gradients' else 'hinge'}"))


def test_a_draw_is_refused_if_no_setting_is_drawn(compose_config):
    with pytest.raises(ValueError, match=r"only a method of method/space reads draw: add \+method=space/NAME"):
        check_references(compose_config("renderer=dist", "draw=3"))
    check_references(compose_config("+method=space/dist_mask", "draw=3"))
