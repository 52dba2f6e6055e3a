"""One self-contained HTML page for every report: the result first, then the evidence.

page = Page("Identification", "rig A (simulated), corner FL")
page.verdict(True, "All targets met")
section = page.section("Stiffness path", "What was done, in a sentence.")
section.table(["quantity", "value"], [["relaxation time", "28.4 ms"]])
section.figure(time_figure([Panel("Clamp force", "kN", [Trace("reference", t, f, REFERENCE)])]), "Caption.")
page.write(path)
"""
