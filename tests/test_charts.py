"""The legend of a chart lists its visible curves, and a note lists the curves outside its frame."""

import re

from spelgen.render.charts import Band, Line, line_chart


def test_the_legend_has_the_curves_that_are_visible():
    chart = line_chart(
        [
            Line("inside", (0, 1, 2), (0.1, 0.5, 0.9), "model"),
            Line("far above", (0, 1, 2), (7, 8, 9), "urdf"),
            Line("not finite", (0, 1), (float("nan"),) * 2, "least-squares"),
            Band("spread", (0, 2), (0.2, 0.2), (0.4, 0.4), "model"),
        ],
        "title", "t [s]", "torque [Nm]", limits=(0.0, 1.0),
    )  # fmt: skip
    assert chart.legend == (("line model", "inside"), ("band model", "spread"))
    assert "partly outside: far above" in chart.svg


def test_no_tick_lies_over_the_title_of_the_axis():
    line = Line("small", (0, 1), (-3e-4, -1e-4), "model")
    chart = line_chart([line], "title", "t [s]", "error [m]", height=84)
    texts = re.findall(r'<text x="([\d.]+)" y="([\d.]+)"[^>]*>([^<]*)', chart.svg)
    (title,) = [float(y) for _, y, text in texts if text == "error [m]"]
    assert all(float(y) > title + 8 for _, y, text in texts if text.startswith("-0.0"))
