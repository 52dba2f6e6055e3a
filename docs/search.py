"""Hook of the documentation's build: search that works in pages opened as files (`docs/search.js`)."""

import shutil
from pathlib import Path

_SCRIPT = Path(__file__).with_name("search.js")


def on_post_build(config) -> None:
    """Put the script in the place of the theme's own, and the index beside it as a script."""
    folder = Path(config["site_dir"]) / "search"
    index = (folder / "search_index.json").read_text(encoding="utf-8")
    (folder / "index.js").write_text(f"var searchIndex = {index};\n", encoding="utf-8")
    shutil.copyfile(_SCRIPT, folder / "main.js")
    (folder / "worker.js").unlink()
