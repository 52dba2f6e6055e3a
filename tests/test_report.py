"""Pages of the reports."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from emb_daemon.report.figures import BAND, SCREEN_POINTS, Panel, Trace, decimate, time_figure
from emb_daemon.report.page import FAIL, Cell, Page


@given(st.integers(0, 2**32 - 1), st.integers(1, 20_000))
def test_decimation_keeps_every_extreme_and_the_order(seed, samples):
    y = np.random.default_rng(seed).normal(size=samples)
    x = np.arange(len(y)) * 0.004
    few_x, few_y = decimate(x, y)
    assert few_y.min() == y.min() and few_y.max() == y.max()
    assert np.all(np.diff(few_x) > 0.0) and len(few_x) <= SCREEN_POINTS + 2
    assert (few_x[0], few_x[-1]) == (x[0], x[-1])


def test_decimation_keeps_gaps():
    y = np.ones(10_000)
    y[4000:6000] = np.nan
    x, few = decimate(np.arange(10_000), y)
    assert np.isnan(few[(x > 4200) & (x < 5800)]).all() and np.isfinite(few[(x < 3800) | (x > 6200)]).all()


def test_an_axis_holds_every_error_and_not_the_uncertainty_of_the_first_moments():
    time_s = np.arange(5000) / 250.0
    sigma, error = np.full(5000, 40.0), 30.0 * np.sin(time_s)
    sigma[:40], error[2500] = 15e3, 900.0
    traces = [Trace("", time_s, -2.0 * sigma, BAND), Trace("two sigma", time_s, 2.0 * sigma, BAND), Trace("", time_s, error)]
    low, high = time_figure([Panel("error", "N", traces)]).layout.yaxis.range
    assert -200.0 < low < -80.0
    assert 900.0 < high < 1200.0


def test_page_escapes_what_it_is_given_and_holds_the_library_once(tmp_path):
    page = Page("<b>title</b>", "a & b")
    page.verdict(False, "1 < 2")
    section = page.section("S", "<script>alert(1)</script>")
    section.table(["n", "text"], [["1.5", Cell("<i>", FAIL)], ["2", "x"]])
    for _ in range(2):
        section.figure(time_figure([Panel("p", "N", [Trace("</script>", np.arange(3), np.arange(3.0))])]), "c")
    page.write(tmp_path / "r.html")
    text = (tmp_path / "r.html").read_text()
    assert "&lt;b&gt;title" in text and "<script>alert" not in text and "<i>" not in text.split("<script>")[0]
    assert text.count("Plotly.newPlot(place") == 1
    data = text[text.index('id="f1"') :]
    assert data.index("</script>") < data.index('id="f2"')


def test_page_without_plots_carries_no_library():
    page = Page("t")
    page.section("S").items(["a"])
    assert len(page.render()) < 10_000
