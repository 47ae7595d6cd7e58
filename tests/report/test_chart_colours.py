"""The charts of the page have the colours of the figures, by the preset of a row and not by its name."""

from bench.pictures import style
from bench.studies import speed_curves
from tests.report import test_report_speed as of_speed
from tests.report import test_report_stability as of_stability

LABELS = {"+ aggressive": "dist_aggressive", "+ dynamic": "dist_dynamic"}


def assert_alike(result):
    """The series of the page's chart have the colours that the figure's lines of the same name have."""
    figure = {}
    for axis in result.figure.axes:
        for handle, name in zip(*axis.get_legend_handles_labels(), strict=True):
            figure.setdefault(name, (handle.lines[0] if hasattr(handle, "lines") else handle).get_color())
    shown = {each["name"]: each["colour"] for panel in result.chart["panels"] for each in panel["series"]}
    both = set(figure) & set(shown)
    assert len(both) >= 2 and {name: shown[name] for name in both} == {name: figure[name] for name in both}
    return shown


def test_of_the_atlas(tmp_path):
    for label in LABELS:
        for axis in ("wires", "quantised"):
            of_stability.broke(tmp_path, axis, label, 0.5)
    cost = of_stability.made(tmp_path, "stability_cost")
    shown = assert_alike(cost)
    assert shown == {label: style.look(preset).colour for label, preset in LABELS.items()}
    curves = of_stability.made(tmp_path, "stability_curves").chart["panels"][0]["series"]
    assert {each["name"]: each["colour"] for each in curves} == shown
    (panel,) = cost.chart["panels"]
    assert panel["y"]["reversed"] and cost.figure.axes[0].yaxis_inverted()
    assert panel["series"][0]["size"] > panel["series"][1]["size"]  # at the same place: neither is hidden


def test_of_the_front_and_its_curves(tmp_path):
    for index in range(3):
        of_speed.completed(tmp_path, "ours", [9, 6 + index], index=index)
        of_speed.completed(tmp_path, "theirs", [9, 5, 3], index=index, renderer="idr")
    assert_alike(of_speed.made(tmp_path, speed_curves))
    front = of_speed.made(tmp_path).chart["panels"][0]["series"]
    shown = {each["name"]: each["colour"] for each in front}
    assert shown == {name: style.look(name).colour for name in ("dist", "idr")} | {"front": "#888888"}
