"""A renderer is one file and one YAML; every experiment that compares renderers has a row for it."""

import re
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bench.config import build
from bench.records.record import row_name
from bench.records.results import Plan
from bench.runner import compose
from bench.runner.plan import plan_of
from bench.tables import group_choices, names, register_rows
from tests.composing import cells_of, composed

CLASS = (
    "class Mine:\n    def __init__(self, size):\n        self.size = size\n    def render(self, field, rays): ...\n"
    "    def silhouette_loss(self, field, rays, rendering, mask): ...\n"
)
YAMLS = {
    "mine": "_target_: {package}.Mine\nsize: 3\n",
    "mine_first": "defaults: [mine, _self_]\n_label_: Mine, first\n_rows_: {{stability: 0}}\nsize: 4\n",
    "mine_nowhere": "defaults: [mine, _self_]\n_rows_: {{}}\n",
    "mine_on_dist": "defaults: [dist, _self_]\nsteps: 7\n",
}
ROWS = "mine_on_keinert: {base: dist_keinert, _label_: 'Keinert, 1.1', _rows_: {stability: 90}, alpha: 1.1}\n"


@pytest.fixture
def package(tmp_path, monkeypatch) -> str:
    """A user's package, and a folder of YAML files for `--config-dir`."""
    name = f"user_package_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(CLASS)
    (tmp_path / "conf/renderer").mkdir(parents=True)
    for yaml, text in YAMLS.items():
        (tmp_path / f"conf/renderer/{yaml}.yaml").write_text(text.format(package=name))
    (tmp_path / "conf/variants.yaml").write_text(ROWS)
    monkeypatch.syspath_prepend(tmp_path)
    return name


def swept(*arguments: str, folder: Path | None = None) -> Plan:
    """The plan of a sweep, with a folder of a user's YAML files."""
    return plan_of(cells_of(*arguments, "scale=smoke", folder=folder))


def rows(plan: Plan) -> list[str]:
    """The renderers of a plan, each once, in order."""
    return list(dict.fromkeys(cell.renderer for cell in plan.cells))


def test_user_renderers_have_rows_in_an_experiment_that_compares_renderers(tmp_path, package):
    plan = swept("+experiment=stability", "stress=thin_plate", f"packages=[{package}]", folder=tmp_path / "conf")
    renderers = rows(plan)
    assert renderers[0] == "mine_first" and renderers[-2:] == ["mine", "mine_on_dist"]  # the last two have no _rows_
    assert len(renderers) == len(plan.cells) == 1 + 22 + 2 + 1
    assert renderers[-3] == "mine_on_keinert"  # from the user's table
    assert "custom" not in renderers and "mine_nowhere" not in renderers
    cells = {cell.renderer: cell for cell in plan.cells}
    labels = {"mine": "mine", "mine_on_dist": "mine_on_dist", "dist": "DIST, our default"}  # not dist's label
    for name, label in (labels | {"mine_first": "Mine, first", "mine_on_keinert": "Keinert, 1.1"}).items():
        assert row_name(cells[name].config, name) == f"{label}, DIST's mask loss"
    under_another = cells["dist"].config | {"silhouette": {"_label_": "IDR's mask loss"}}
    assert row_name(under_another, "dist") == "DIST, our default, IDR's mask loss"
    built = build(OmegaConf.create(cells["mine"].config["renderer"]), "renderer", [package])
    assert (type(built).__name__, built.size) == ("Mine", 3)
    assert cells["mine_first"].config["renderer"]["size"] == 4
    assert cells["mine_on_keinert"].config["renderer"]["alpha"] == 1.1
    assert not any({"_rows_", "_look_"} & {*cell.config["renderer"]} for cell in plan.cells)
    register_rows()
    assert "mine_on_keinert" not in group_choices("renderer")  # another command had it


def test_the_command_line_narrows_and_replaces_the_rows():
    assert rows(swept("+experiment=table1", "renderer=dvr,dist")) == ["dvr", "dist"]
    plan = swept("+experiment=table1", "renderer=custom", "renderer._target_=renderers.IDR")
    assert [(cell.renderer, row_name(cell.config, cell.renderer)) for cell in plan.cells] == [("custom", "IDR")]


def test_the_name_of_a_run_has_its_method():
    rows = "paper paper_neither paper_clamp dist restarts idr dvr naive mesh mesh_long encoder mesh_encoder"
    methods = [f"multiview_{name}" for name in rows.split()]
    params = composed("+experiment=table3", hydra=True).hydra.sweeper.params
    assert params["+method"].split(",") == methods
    methods = methods[:2]
    plan = swept("+experiment=table3", f"+method={','.join(methods)}", "index=0", "dataset=car")
    assert [cell.method for cell in plan.cells] == methods
    ids = [f"multiview-dist_paper-car-{method}-0" for method in methods]
    assert [cell.id.rsplit("-", 1)[0] for cell in plan.cells] == ids
    plan = swept("seed=0,1")
    assert [cell.id.rsplit("-", 1)[0] for cell in plan.cells] == [
        "completion-dist-sofa-0-points100",
        "completion-dist-sofa-0-seed1-points100",
    ]
    assert [cell.method for cell in plan.cells] == ["", ""]


def test_the_later_of_two_values_of_a_key_counts_at_the_position_of_the_first():
    plan = swept("seed=0,1", "dataset=glob(c*,exclude=car)", "index=3", "seed=range(5,7)")
    cells = [cell.config for cell in plan.cells]
    assert [(config["dataset"]["name"], config["index"], config["seed"]) for config in cells] == [
        (name, 3, seed) for seed in (5, 6) for name in ("capsule", "cylinder")
    ]


MINE = "# @package _global_\ndefaults: [tuning, _self_]\nhydra: {sweeper: {params: {+method: '${spaces:neus}'}}}\n"
SLOW = {f"{name}_mask" for name in ("neus", "range_analysis", "unisurf", "volsdf")}
USER_ROWS = {
    "methods": "mine_row: &mine {renderer: dist, label: Mine, space: {renderer.alpha: '${drawn:3,1.0,2.0}'}}\n"
    "mine_untuned: *mine\n",
    "tuned": "mine_row: {base: /method/mine_row, label: 'Mine, tuned', renderer.alpha: 1.25}\n",
}


def test_user_methods_join_the_tuning_and_slow_ones_do_not(tmp_path):
    (tmp_path / "own").mkdir()
    for table, text in USER_ROWS.items():
        (tmp_path / f"own/{table}.yaml").write_text(text)
    spaces, user_methods = {*names("method/space")}, {"mine_row", "mine_untuned"}
    plan = swept("+experiment=tuning", "draw=3", "split=test", folder=tmp_path / "own")
    cells = {cell.method.removeprefix("space/"): cell for cell in plan.cells}
    assert {*cells} == (spaces - SLOW) | user_methods
    mine = cells["mine_row"].config
    assert mine["label"] == "Mine" and 1 < mine["renderer"]["alpha"] < 2
    plan = swept("+method=mine_row,tuned/mine_row", folder=tmp_path / "own")
    tuned = {cell.method: cell.config["renderer"]["alpha"] for cell in plan.cells}
    assert tuned == {"mine_row": 1.5, "tuned/mine_row": 1.25}


@pytest.mark.parametrize(("file", "text", "message"), [
    ("variants.yaml", "mine: 3\n", "variants.yaml: mine must be a row, {key: value}, not 3"),
    ("variants.yaml", "- mine\n", "variants.yaml must hold keys and values"),
    ("variants.yaml", "mine: {a: 1\n", "variants.yaml cannot be read: while parsing"),
    ("renderer/list.yaml", "- 1\n", "renderer/list.yaml must hold keys and values"),
    ("experiment/mine.yaml", MINE, "${spaces:...} leaves out neus: not in method/space"),
])  # fmt: skip
def test_a_broken_file_of_the_users_is_named(tmp_path, file, text, message):
    (tmp_path / "own" / file).parent.mkdir(parents=True)
    (tmp_path / "own" / file).write_text(text)
    experiment = "+experiment=mine" if "experiment" in file else "+experiment=table1"
    with pytest.raises((ValueError, OmegaConfBaseException), match=re.escape(message)):
        swept(experiment, folder=tmp_path / "own")


def test_a_sweep_composes_each_combination_of_choices_once(monkeypatch):
    composed, do = [], compose.compose_choices
    monkeypatch.setattr(compose, "compose_choices", lambda choices: (composed.append(choices), do(choices))[1])
    plan = swept("seed=0,1,2", "renderer=dist,dvr", "task.points=20,30")
    assert len(plan.cells) == 12 and len(composed) == 1 + 2  # the first composition reads what is swept over


def test_a_users_choice_takes_no_shipped_name(tmp_path):
    for number, (file, text) in enumerate(
        {"variants.yaml": "dist: {base: idr}\n", "renderer/dist_aggressive.yaml": "defaults: [dist, _self_]\n"}.items()
    ):
        path = tmp_path / str(number) / file
        path.parent.mkdir(parents=True)
        path.write_text(text)
        with pytest.raises(ValueError, match=r"already: give the (row|file) another name"):
            register_rows([tmp_path / str(number)])
    register_rows()
