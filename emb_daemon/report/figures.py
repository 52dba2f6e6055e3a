"""Figures of the reports: few colours with one meaning each, time axes that zoom together, data reduced for the screen."""

import base64
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

ACCENT = "#0b5cad"
INK = "#1d2430"
MUTED = "#6b7480"
GRID = "#e6e9ee"

#: Largest number of points of a trace on the page; more cannot be distinguished on a screen.
SCREEN_POINTS = 3000
#: Largest number of samples of a figure that the page stores for zooming: six megabytes.
DETAIL_SAMPLES = 1_000_000
#: Quantiles of a band's edges that an axis covers. The widest hundredth comes from power-on (`_extent`).
_IN_BAND = (0.01, 0.99)


@dataclass(frozen=True)
class Style:
    """Appearance of a trace, by its meaning."""

    colour: str
    width: float = 1.4
    dash: str = "solid"
    mode: str = "lines"
    #: Diameter of markers, pixels.
    size: float = 7.0


REFERENCE = Style(INK, 1.6)
MODEL = Style(ACCENT, 1.4)
PALE = Style("#9aa4b1", 1.0)
MARKS = Style(ACCENT, mode="markers")
#: Style with a pale band between a trace and the one before it: give the lower edge first, then the upper.
BAND = Style("rgba(11,92,173,0.18)", 0.0)


@dataclass(frozen=True)
class Trace:
    """One line or set of points. ``sigma`` draws error bars of one standard deviation."""

    name: str
    x: np.ndarray
    y: np.ndarray
    style: Style = MODEL
    sigma: np.ndarray | None = field(default=None, repr=False)


@dataclass(frozen=True)
class Panel:
    """One set of axes; those of a figure stand under each other."""

    title: str
    unit: str
    traces: list[Trace]
    height: int = 260


def decimate(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most about `SCREEN_POINTS` of a curve, smallest and largest of every bucket, so that no peak is lost.

    A bucket that is entirely NaN remains a gap."""
    x, y = np.asarray(x), np.asarray(y, dtype=float)
    if len(y) <= SCREEN_POINTS:
        return x, y
    edges = np.linspace(0, len(y), SCREEN_POINTS // 2 + 1).astype(np.int64)
    rows = []
    for begin, end in pairwise(edges):
        part = y[begin:end]
        if np.isnan(part).all():
            rows.append(begin)
            continue
        rows += sorted({begin + int(np.nanargmin(part)), begin + int(np.nanargmax(part))})
    rows = np.array(sorted({0, *rows, len(y) - 1}))
    return x[rows], y[rows]


def shades(count: int) -> list[str]:
    """``count`` shades of the accent, light to dark, for a quantity in order."""
    light, dark = np.array([147, 190, 232]), np.array([6, 44, 92])
    shares = np.linspace(0.0, 1.0, count) if count > 1 else [1.0]
    return [f"rgb({','.join(str(round(v)) for v in light + s * (dark - light))})" for s in shares]


def _figure(panels: list[Panel], x_title: str, *, reduce: bool, shared: bool):
    from plotly.subplots import make_subplots

    heights = [panel.height for panel in panels]
    gap = 46
    total = sum(heights) + gap * (len(panels) - 1)
    figure = make_subplots(
        rows=len(panels), cols=1, shared_xaxes=shared, vertical_spacing=gap / total if len(panels) > 1 else 0.0,
        row_heights=heights, subplot_titles=[panel.title for panel in panels],
    )  # fmt: skip
    shown: set[str] = set()
    detail = _Detail()
    for row, panel in enumerate(panels, start=1):
        _draw(figure, row, panel, shown, detail if reduce else None)
    figure.update_xaxes(title_text=x_title, row=len(panels), col=1)
    axis = {"gridcolor": GRID, "zeroline": False, "linecolor": "#b8c0ca", "ticks": "outside", "tickcolor": "#b8c0ca"}
    figure.update_xaxes(**axis)
    figure.update_yaxes(**axis, title_standoff=8)
    figure.update_layout(
        meta=detail.times or None,
        height=total + 128,
        margin={"l": 64, "r": 16, "t": 80, "b": 48},
        paper_bgcolor="white",
        plot_bgcolor="white",
        font={"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 12.5, "color": INK},
        legend={"orientation": "h", "yanchor": "bottom", "y": 1.0 + 22.0 / total, "xanchor": "right", "x": 1.0},
        hovermode="x unified" if shared else "closest",
        hoverlabel={"font": {"size": 12}},
    )
    for annotation in figure.layout.annotations:
        annotation.update(font={"size": 13, "color": MUTED}, x=0.0, xanchor="left")
    return figure


def _draw(figure, row: int, panel: Panel, shown: set[str], detail: "_Detail | None") -> None:
    """A panel's traces; ``shown`` are the names that are already in the legend. With ``detail`` lines are decimated, and their
    samples are stored there for zooming."""
    from plotly.graph_objects import Scatter

    band_open = False
    for trace in panel.traces:
        x, y, whole = np.asarray(trace.x, dtype=np.float64), np.asarray(trace.y, dtype=float), None
        if detail and trace.style.mode == "lines":
            whole = detail.kept(x, y)
            x, y = decimate(x, y)
        style, is_band = trace.style, trace.style is BAND
        opens_band = is_band and not band_open
        scatter = Scatter(
            x=x,
            # Single precision is enough for the eye and halves the file.
            y=y.astype(np.float32),
            name=trace.name,
            meta=whole,
            mode=style.mode,
            line={"color": style.colour, "width": style.width, "dash": style.dash},
            marker={"color": style.colour, "size": style.size},
            fill="tonexty" if is_band and band_open else None,
            fillcolor=style.colour if is_band else None,
            hoverinfo="skip" if is_band else None,
            error_y=None if trace.sigma is None else {"type": "data", "array": trace.sigma, "thickness": 1, "width": 3},
            legendgroup=trace.name,
            showlegend=bool(trace.name) and trace.name not in shown and not opens_band,
        )
        figure.add_trace(scatter, row=row, col=1)
        if not opens_band:
            shown.add(trace.name)
        band_open = opens_band
    figure.update_yaxes(title_text=panel.unit, range=_extent(panel), row=row, col=1)


def _extent(panel: Panel) -> list[float] | None:
    """Range of a panel's axis if it has a band: all of its lines, and the band without its widest samples; else plotly's.

    Before the contact angle is known, a standard deviation is as large as the largest force; on that scale everything later
    would look like a straight line."""
    if not any(trace.style is BAND for trace in panel.traces):
        return None
    edges = []
    for trace in panel.traces:
        y = np.asarray(trace.y, dtype=float)
        y = y[np.isfinite(y)]
        if len(y):
            edges += [*np.quantile(y, _IN_BAND)] if trace.style is BAND else [y.min(), y.max()]
    if not edges:
        return None
    margin = 0.05 * (max(edges) - min(edges)) or 1.0
    return [float(min(edges) - margin), float(max(edges) + margin)]


class _Detail:
    """All samples of a figure's reduced traces, in base64 for the page's script; times that several traces share are stored
    once. ``times``: by name, s, double precision."""

    def __init__(self):
        self.times: dict[str, str] = {}
        self._names: dict[bytes, str] = {}
        self._left = DETAIL_SAMPLES

    def kept(self, x: np.ndarray, y: np.ndarray) -> dict[str, str] | None:
        """Data of a trace: the name of its times, and its values in single precision; None if the page does not need them or
        has no room for them."""
        if not SCREEN_POINTS < len(y) <= self._left:
            return None
        self._left -= len(y)
        times = np.ascontiguousarray(x, dtype="<f8").tobytes()
        name = self._names.setdefault(times, f"t{len(self._names)}")
        self.times.setdefault(name, base64.b64encode(times).decode())
        return {"times": name, "values": base64.b64encode(np.ascontiguousarray(y, dtype="<f4").tobytes()).decode()}


def time_figure(panels: list[Panel]) -> "Figure":
    """Panels over one time axis; zooming one zooms all, down to single samples. Shown points are decimated; peaks stay."""
    return _figure(panels, "time / s", reduce=True, shared=True)


def xy_figure(panels: list[Panel], x_title: str) -> "Figure":
    """Panels over a quantity other than time."""
    return _figure(panels, x_title, reduce=False, shared=len(panels) > 1)
