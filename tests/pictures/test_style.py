"""Legends below a figure stay within it."""

from matplotlib.figure import Figure

from bench.pictures.style import legend_below


def test_a_legend_wider_than_the_figure_takes_fewer_columns():
    for length, columns in ((3, 4), (30, 2), (300, 1)):
        figure = Figure(figsize=(7, 3), layout="constrained")
        axes = figure.subplots()
        for name in range(8):
            axes.plot([0, 1], [name, name], label=f"{name}".ljust(length, "x"))
        legend_below(figure, axes)
        (legend,) = figure.legends
        assert legend._ncols == columns
        assert legend.get_window_extent().width <= figure.bbox.width or columns == 1
