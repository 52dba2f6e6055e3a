"""The page: verdict, sections, tables. Everything is inside one file; nothing is loaded from elsewhere."""

import html
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from emb_daemon.atomic import write_atomically
from emb_daemon.report.figures import SCREEN_POINTS

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

PASS, FAIL = "pass", "fail"
_STYLE, _DRAW = (Path(__file__).with_name(name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))


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

    def table(self, columns: list[str], rows: Sequence[Sequence[object]], caption: str = "") -> "Section":
        """A table; a column in which every entry begins with a digit or a sign is aligned right.

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

    def figure(self, figure: "Figure", caption: str = "") -> "Section":
        """A plotly figure as `report.figures` builds them."""
        name = self._page.add_figure(figure)
        height = figure.layout.height or 400
        below = f"<figcaption>{html.escape(caption)}</figcaption>" if caption else ""
        self._parts.append(f'<figure><div data-figure="{name}" style="height:{height:.0f}px"></div>{below}</figure>')
        return self

    def render(self) -> str:
        return f'<section id="{self.anchor}"><h2>{html.escape(self.title)}</h2>{"".join(self._parts)}</section>'


class Page:
    """A report. The subtitle states data, time and version, and must say if the data are simulated."""

    def __init__(self, title: str, subtitle: str = ""):
        self.title = title
        self.subtitle = subtitle
        self._verdict = ""
        self._sections: list[Section] = []
        self._figures: list[str] = []

    def verdict(self, good: bool | None, headline: str, details: list[str] | None = None) -> None:
        """The result, before all evidence. ``good`` None: neither good nor bad."""
        state = "" if good is None else PASS if good else FAIL
        lines = "".join(f"<p>{html.escape(line)}</p>" for line in details or [])
        self._verdict = f'<div class="verdict {state}"><strong>{html.escape(headline)}</strong>{lines}</div>'

    def section(self, title: str, text: str = "") -> Section:
        section = Section(title, f"s{len(self._sections) + 1}", self)
        self._sections.append(section)
        return section.text(text) if text else section

    def add_figure(self, figure: "Figure") -> str:
        """Keep a figure's data; returns the element id that holds them."""
        # JSON that cannot end the script element that contains it.
        self._figures.append(figure.to_json().replace("<", "\\u003c"))
        return f"f{len(self._figures)}"

    def render(self) -> str:
        """The complete file. The plot library is included once, and only if there is a plot."""
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
        """Write the page completely or not at all. Raises OSError: the folder cannot be written."""
        write_atomically(Path(path), self.render().encode())


def _is_number(text: str) -> bool:
    return not text or text[0] in "+-−±<≤–" or text[0].isdigit()
