"""One self-contained HTML page for every report: what was found first, then the evidence.

page = Page("Identification", "rig A (simulated), corner FL")
page.verdict(True, "All targets met")
section = page.section("Stiffness path", "What was done, in a sentence.")
section.table(["quantity", "value"], [["relaxation time", "28.4 ms"]])
section.figure(time_figure([Panel("Clamp force", "kN", [Trace("reference", t, f, REFERENCE)])]), "Caption.")
page.write(path)
"""

from emb_daemon.report.figures import (
    ACCENT,
    BAND,
    MARKS,
    MODEL,
    PALE,
    REFERENCE,
    Panel,
    Trace,
    decimate,
    shades,
    time_figure,
    xy_figure,
)
from emb_daemon.report.page import FAIL, PASS, Cell, Page, Section

__all__ = [
    "ACCENT",
    "BAND",
    "FAIL",
    "MARKS",
    "MODEL",
    "PALE",
    "PASS",
    "REFERENCE",
    "Cell",
    "Page",
    "Panel",
    "Section",
    "Trace",
    "decimate",
    "shades",
    "time_figure",
    "xy_figure",
]
