"""The page: verdict, sections, tables. Everything inside one file, nothing fetched."""

import html
from dataclasses import dataclass, field
from pathlib import Path

from emb_daemon.atomic import write_atomically
from emb_daemon.report.figures import SCREEN_POINTS

PASS, FAIL = "pass", "fail"

_STYLE = """
:root { --ink:#1d2430; --muted:#6b7480; --line:#dfe4ea; --accent:#0b5cad; --good:#1b7f4b; --bad:#b3261e; --wash:#f6f8fa; }
* { box-sizing: border-box; }
html { scroll-behavior: smooth; }
body { margin: 0; color: var(--ink); background: #fff; font: 15.5px/1.55 system-ui, -apple-system, "Segoe UI", Roboto,
  "Helvetica Neue", sans-serif; font-variant-numeric: tabular-nums; }
main { max-width: 1040px; margin: 0 auto; padding: 40px 28px 80px; }
h1 { font-size: 28px; line-height: 1.2; margin: 0 0 4px; letter-spacing: -0.01em; }
h2 { font-size: 20px; margin: 52px 0 8px; padding-top: 14px; border-top: 1px solid var(--line); letter-spacing: -0.005em; }
h3 { font-size: 16px; margin: 28px 0 6px; }
p { max-width: 76ch; margin: 8px 0; }
.subtitle { color: var(--muted); margin: 0 0 22px; }
.verdict { border-left: 5px solid var(--accent); background: var(--wash); padding: 14px 20px; margin: 0 0 22px; }
.verdict strong { display: block; font-size: 19px; line-height: 1.35; }
.verdict p { margin: 6px 0 0; }
.verdict.pass { border-color: var(--good); } .verdict.pass strong { color: var(--good); }
.verdict.fail { border-color: var(--bad); } .verdict.fail strong { color: var(--bad); }
nav { font-size: 14px; color: var(--muted); margin: 0 0 8px; }
nav a { color: var(--accent); text-decoration: none; margin-right: 16px; white-space: nowrap; }
nav a:hover { text-decoration: underline; }
.scroll { overflow-x: auto; margin: 12px 0 18px; }
table { border-collapse: collapse; font-size: 14px; min-width: 50%; }
caption { caption-side: bottom; text-align: left; color: var(--muted); font-size: 13px; padding-top: 6px; }
th { text-align: left; font-weight: 600; color: var(--muted); border-bottom: 1.5px solid var(--ink); padding: 5px 18px 5px 0;
  vertical-align: bottom; }
td { border-bottom: 1px solid var(--line); padding: 5px 18px 5px 0; vertical-align: top; }
th.number, td.number { text-align: right; } td.number { white-space: nowrap; }
td.pass { color: var(--good); font-weight: 600; }
td.fail { color: var(--bad); font-weight: 600; }
th:last-child, td:last-child { padding-right: 0; }
figure { margin: 14px 0 22px; }
figcaption { color: var(--muted); font-size: 13.5px; max-width: 90ch; }
ul { max-width: 90ch; padding-left: 20px; margin: 8px 0; } li { margin: 3px 0; }
code { font: 13px/1.4 ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; background: var(--wash); padding: 1px 4px; }
footer { margin-top: 56px; border-top: 1px solid var(--line); padding-top: 12px; color: var(--muted); font-size: 13px; }
@page { size: A4; margin: 14mm; }
@media print {
  body { font-size: 10.5pt; } main { max-width: none; padding: 0; } nav { display: none; }
  h2, h3 { break-after: avoid; } .modebar-container { display: none; }
  figure, tr, .verdict { break-inside: avoid; } .scroll { overflow: visible; }
  .verdict { -webkit-print-color-adjust: exact; print-color-adjust: exact; }
}
"""

_DRAW = """
function floats(text, Type) {
  return new Type(Uint8Array.from(atob(text), function (letter) { return letter.charCodeAt(0); }).buffer);
}
// First row at or after a time.
function rowAt(times, time) {
  var low = 0, high = times.length;
  while (low < high) { var middle = (low + high) >> 1; if (times[middle] < time) low = middle + 1; else high = middle; }
  return low;
}
// Rows of a stretch, all of them or the smallest and largest of each bucket.
function rowsOf(values, first, last, points) {
  var rows = [], count = last - first, bucket = Math.max(1, 2 * count / points);
  for (var number = 0, start = first, end; start < last; start = end) {
    end = Math.min(last, first + Math.round(++number * bucket));
    var low = -1, high = -1;
    for (var row = start; row < end; row++) {
      if (isNaN(values[row])) continue;
      if (low < 0 || values[row] < values[low]) low = row;
      if (high < 0 || values[row] > values[high]) high = row;
    }
    if (low < 0) rows.push(start);
    else if (low === high) rows.push(low);
    else rows.push(Math.min(low, high), Math.max(low, high));
  }
  return rows;
}
// Every sample of the traces of a plot that were thinned out.
function detailOf(place) {
  var times = {}, kept = [];
  Object.entries(place.layout.meta || {}).forEach(function (entry) { times[entry[0]] = floats(entry[1], Float64Array); });
  place.data.forEach(function (trace, number) {
    if (trace.meta && trace.meta.values) {
      kept.push({number: number, times: times[trace.meta.times], values: floats(trace.meta.values, Float32Array)});
    }
  });
  return kept;
}
function showDetail(place) {
  var kept = null;
  place.on("plotly_relayout", function (change) {
    if (!Object.keys(change).some(function (key) { return key.startsWith("xaxis"); })) return;
    kept = kept || detailOf(place);
    if (!kept.length) return;
    var range = place._fullLayout.xaxis.range, whole = change["xaxis.autorange"] === true, x = [], y = [];
    kept.forEach(function (trace) {
      var first = whole ? 0 : Math.max(0, rowAt(trace.times, range[0]) - 1);
      var last = whole ? trace.times.length : Math.min(trace.times.length, rowAt(trace.times, range[1]) + 1);
      var rows = rowsOf(trace.values, first, last, POINTS);
      x.push(rows.map(function (row) { return trace.times[row]; }));
      y.push(rows.map(function (row) { return trace.values[row]; }));
    });
    Plotly.restyle(place, {x: x, y: y}, kept.map(function (trace) { return trace.number; }));
  });
}
document.querySelectorAll("[data-figure]").forEach(function (place) {
  var figure = JSON.parse(document.getElementById(place.dataset.figure).textContent);
  Plotly.newPlot(place, figure.data, figure.layout,
    {responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"]});
  showDetail(place);
});
window.addEventListener("beforeprint", function () {
  document.querySelectorAll("[data-figure]").forEach(function (place) { Plotly.Plots.resize(place); });
});
"""


@dataclass(frozen=True)
class Cell:
    """A table cell with a judgement: ``PASS`` or ``FAIL``."""

    text: str
    state: str = ""


@dataclass
class Section:
    """A part of the page with an anchor of its own."""

    title: str
    anchor: str
    _page: "Page" = field(repr=False)
    _parts: list[str] = field(default_factory=list, repr=False)

    def text(self, text: str) -> "Section":
        """A paragraph of plain text."""
        self._parts.append(f"<p>{html.escape(text)}</p>")
        return self

    def heading(self, text: str) -> "Section":
        self._parts.append(f"<h3>{html.escape(text)}</h3>")
        return self

    def items(self, texts: list[str]) -> "Section":
        """A list of plain texts."""
        self._parts.append("<ul>" + "".join(f"<li>{html.escape(text)}</li>" for text in texts) + "</ul>")
        return self

    def table(self, columns: list[str], rows: list[list], caption: str = "") -> "Section":
        """A table; a column in which every entry begins with a digit or a sign stands flush right.

        Entries are texts or `Cell`."""
        cells = [[entry if isinstance(entry, Cell) else Cell(str(entry)) for entry in row] for row in rows]
        numeric = [
            bool(cells) and all(_is_number(row[index].text) for row in cells) and any(row[index].text for row in cells)
            for index in range(len(columns))
        ]
        head = "".join(
            f"<th{' class=number' if is_number else ''}>{html.escape(name)}</th>"
            for name, is_number in zip(columns, numeric, strict=True)
        )
        body = "".join(
            "<tr>"
            + "".join(
                f'<td class="{"number " if is_number else ""}{cell.state}">{html.escape(cell.text)}</td>'
                for cell, is_number in zip(row, numeric, strict=True)
            )
            + "</tr>"
            for row in cells
        )
        below = f"<caption>{html.escape(caption)}</caption>" if caption else ""
        self._parts.append(
            f'<div class="scroll"><table>{below}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
        )
        return self

    def figure(self, figure, caption: str = "") -> "Section":
        """A plotly figure as `report.figures` builds them."""
        name = self._page.add_figure(figure)
        height = figure.layout.height or 400
        below = f"<figcaption>{html.escape(caption)}</figcaption>" if caption else ""
        self._parts.append(f'<figure><div data-figure="{name}" style="height:{height:.0f}px"></div>{below}</figure>')
        return self

    def render(self) -> str:
        return f'<section id="{self.anchor}"><h2>{html.escape(self.title)}</h2>{"".join(self._parts)}</section>'


class Page:
    """A report.

    Args:
        title: what it is.
        subtitle: of what, when, by which version. State there when data are simulated.
    """

    def __init__(self, title: str, subtitle: str = ""):
        self.title = title
        self.subtitle = subtitle
        self._verdict = ""
        self._sections: list[Section] = []
        self._figures: list[str] = []

    def verdict(self, good: bool | None, headline: str, details: list[str] | None = None) -> None:
        """The answer, before all evidence. ``good`` None: neither good nor bad."""
        state = "" if good is None else PASS if good else FAIL
        lines = "".join(f"<p>{html.escape(line)}</p>" for line in details or [])
        self._verdict = f'<div class="verdict {state}"><strong>{html.escape(headline)}</strong>{lines}</div>'

    def section(self, title: str, text: str = "") -> Section:
        section = Section(title, f"s{len(self._sections) + 1}", self)
        self._sections.append(section)
        return section.text(text) if text else section

    def add_figure(self, figure) -> str:
        """Keep a figure's data; returns the element id that holds them."""
        self._figures.append(_inside_script(figure.to_json()))
        return f"f{len(self._figures)}"

    def render(self) -> str:
        """The whole file. The plot library is inside, once, and only if there is a plot."""
        links = " ".join(f'<a href="#{section.anchor}">{html.escape(section.title)}</a>' for section in self._sections)
        data = "".join(
            f'<script type="application/json" id="f{number}">{text}</script>\n'
            for number, text in enumerate(self._figures, start=1)
        )
        library = ""
        if self._figures:
            from plotly.offline import get_plotlyjs

            library = (
                f"<script>{get_plotlyjs()}</script>\n{data}<script>{_DRAW.replace('POINTS', str(SCREEN_POINTS))}</script>"
            )
        return (
            f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            f'<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{html.escape(self.title)}</title><style>{_STYLE}</style></head><body><main>\n"
            f'<h1>{html.escape(self.title)}</h1><p class="subtitle">{html.escape(self.subtitle)}</p>\n'
            f"{self._verdict}\n<nav>{links if len(self._sections) > 1 else ''}</nav>\n"
            + "\n".join(section.render() for section in self._sections)
            + f"\n</main>\n{library}</body></html>\n"
        )

    def write(self, path: Path) -> None:
        """Write the page whole or not at all.

        Raises:
            OSError: the folder cannot be written.
        """
        write_atomically(Path(path), self.render().encode())


def _is_number(text: str) -> bool:
    return not text or text[0] in "+-−±<≤–" or text[0].isdigit()


def _inside_script(text: str) -> str:
    """JSON that cannot end the script element it stands in."""
    return text.replace("<", "\\u003c")
