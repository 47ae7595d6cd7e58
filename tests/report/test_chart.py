"""A chart is drawn as a figure from the data that the page gets; a verdict is written of numbers."""

import math

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection

from bench.pictures import figure_style
from bench.report.data.statistics import Interval
from bench.report.write.chart import curve, draw, level, panel_data, series
from bench.report.write.table import extremes
from tests.looped import each

KNOWN = [Interval(2.0, 1.0, 4.0), Interval(20.0, 10.0, math.inf)]
FEW = [Interval(2.0, math.nan, math.nan, (1.0, 3.0))]


def axis_of(*drawn, **panel):
    (axis,) = draw([panel_data("title", "x", "y", list(drawn), **panel)], 2.0).axes
    return axis


def test_a_row_has_its_preset_s_look_in_the_figure_and_on_the_page():
    made = curve("DIST", "dist", [1, 2], [0, 5])
    (line,) = axis_of(made).lines
    assert made["colour"] == line.get_color() == figure_style.look("dist").colour == "#0072b2"
    assert made["symbol"] == line.get_marker() and made["dash"] == line.get_linestyle() == "-"
    assert line.get_label() == "DIST" and list(line.get_ydata()) == [0, 5]


def test_positions_with_names_are_evenly_apart_also_where_the_first_has_no_value():
    drawn = [series("b", "dist", [2.0], [1]), series("c", "idr", [3.0], [8])]
    assert not panel_data("", "x", "", drawn, rows=list("abcdefghi"))["y"]["log"]
    crossed = [series(each["name"], "dist", each["y"], each["x"]) for each in drawn]
    assert not panel_data("", "", "y", crossed, ticks=list("abcdefghi"))["x"]["log"]


def test_an_axis_is_logarithmic_where_its_values_are_positive_and_spread():
    panel = panel_data("", "x", "y", [series("a", "dist", [1, 100], [0, 5])])
    assert panel["x"] == {"title": "x", "log": True} and panel["y"] == {"title": "y", "log": False}
    (axis,) = draw([panel], 2.0).axes
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "linear")


def test_intervals_are_a_band_around_a_line_and_bars_of_points():
    line, points = (axis_of(kind("a", "dist", [1, 2], KNOWN)) for kind in (curve, series))
    (band,), (bars,) = line.collections, points.collections
    assert isinstance(band, PolyCollection) and isinstance(bars, LineCollection)
    assert [segment[:, 1].tolist() for segment in bars.get_segments()] == [[1, 4], [10, 40]]  # ∞ is at the edge
    assert band.get_paths()[0].vertices[:, 1].max() == 40


@pytest.mark.parametrize("positions", [[1, 2], [1, 16]], ids=["linear", "logarithmic"])
def test_many_lines_have_bars_next_to_each_other(positions):
    axis = axis_of(*(curve(name, "dist", positions, KNOWN) for name in "abcde"))
    bars = np.array([[segment[0, 0] for segment in bar.get_segments()] for bar in axis.collections])
    assert all(isinstance(bar, LineCollection) for bar in axis.collections)
    assert (np.diff(bars, axis=0) > 0).all() and bars[2].tolist() == pytest.approx(positions)
    assert bars[-1, 0] < 1.2 and [line.get_xdata().tolist() for line in axis.lines] == bars.tolist()


@pytest.mark.parametrize("positions", [[1], [1, 1.05, 100], [1, 2, math.inf]], ids=["one", "close", "infinite"])
def test_bars_do_not_reach_the_next_position(positions):
    known = [Interval(2.0, 1.0, 4.0)] * len(positions)
    axis = axis_of(*(curve(name, "dist", positions, known) for name in "abcdefgh"))
    drawn = np.array([line.get_xdata() for line in axis.lines]).T  # [position, line]
    assert np.isfinite(drawn).all() and (np.diff(drawn[:2].flatten()) > 0).all()


def test_lines_keep_their_order_whether_they_have_intervals_or_not():
    exact = curve("exact", "dist", [1, 16], [1, 2])
    for count in (2, 6):  # with bands, and with bars
        others = [curve(name, "dist", [1, 16], KNOWN) for name in "abcdef"[:count]]
        drawn = axis_of(others[0], exact, *others[1:]).lines
        assert [line.get_label() for line in drawn] == ["a", "exact", *"bcdef"[: count - 1]]
        assert list(drawn[1].get_xdata()) == [1, 16]


def test_without_an_interval_the_points_of_the_shapes_are_drawn():
    made = series("a", "dist", [7], FEW)
    assert "low" not in made and made["shapes"] == [[7, 1], [7, 3]]
    _, shapes = axis_of(made).lines
    assert shapes.get_markersize() == 2 and np.transpose(shapes.get_data()).tolist() == made["shapes"]
    far = series("a", "dist", [7], [Interval(2.0, math.nan, math.nan, (1.0, 30.0))])  # above twice the median
    assert axis_of(far).lines[1].get_ydata().tolist() == [1, 30]


def test_in_a_panel_with_names_of_rows_intervals_and_shapes_are_along_x():
    drawn = axis_of(series("a", "dist", KNOWN, [0, 1]), series("b", "idr", FEW, [2]), rows=["p", "q", "r"])
    (bars,) = drawn.collections
    assert [segment.tolist() for segment in bars.get_segments()] == [[[1, 0], [4, 0]], [[10, 1], [40, 1]]]
    assert np.transpose(drawn.lines[-1].get_data()).tolist() == [[1, 2], [3, 2]]


def test_the_ticks_of_x_do_not_depend_on_the_intervals_of_y():
    errors = [Interval(0.1, 0.01, 0.2)] * 2
    ticks = axis_of(series("a", "dist", [1e7, 9e7], errors)).get_xticklabels(minor=True)
    assert {"2e7", "5e7"} <= {tick.get_text() for tick in ticks}


def test_looks_of_the_page_are_those_of_the_figure():
    hollow = series("a", "dist", [1], [1], hollow=True, size=10)
    step = curve("b", "idr", [1, 2], [1, 2], step=True, quiet=True)
    drawn = axis_of(hollow, step, series("c", "dvr", [1], [9], off=True), level("exact", [1, 2], 1.5), ticks=["p", "q"])
    points, steps, exact = drawn.lines
    assert points.get_markerfacecolor() == "none" and points.get_markersize() == pytest.approx(5.5)
    assert steps.get_drawstyle() == "steps-post" and list(exact.get_ydata()) == [1.5, 1.5]
    assert [text.get_text() for text in drawn.figure.legends[0].get_texts()] == ["a", "exact"]
    assert [label.get_text() for label in drawn.get_xticklabels()] == ["p", "q"]


def test_of_axes_that_are_shared_the_first_alone_is_named_and_places_without_a_panel_are_empty():
    panel = panel_data("", "x", "y", [series("a", "dist", [1], [1])])
    axes = draw([panel] * 3, 2.0, 2, sharey=True).axes
    assert [axis.get_ylabel() for axis in axes] == ["y", "", "y", ""] and not axes[3].axison


@each("shared, edge", [({"sharey": "row"}, 8.0), ({"sharey": True}, 200.0), ({}, 2.0)])
def test_what_is_infinite_is_above_all_that_its_axis_shows(shared, edge):
    values = [[1.0, math.inf], [1.0, 4.0], [1.0, 100.0]]
    panels = [panel_data("", "x", "y", [curve("a", "dist", [1, 2], own)]) for own in values]
    assert draw(panels, 2.0, 2, **shared).axes[0].lines[0].get_ydata()[1] == edge


def test_a_verdict_has_the_best_and_the_worst_row_and_none_where_nothing_is_finite():
    values = {"a": 2.0, "b": math.inf, "c": 1.0, "d": None, "e": math.nan}
    assert extremes("Error", values, "3 shapes") == "Error: *1.00* (c) to ∞ (b); n = 3 shapes."
    largest = extremes("Score", {"a": 2.0, "c": 1.0}, "3 shapes", largest_first=True)
    assert largest == "Score: *2.00* (a) to 1.00 (c); n = 3 shapes."
    assert extremes("Error", {"a": 2.0}, "1 shape") == "Error: *2.00* (a); n = 1 shape."
    assert extremes("Error", {"b": math.inf}, "3 shapes") == extremes("Error", {}, "3 shapes") == ""
