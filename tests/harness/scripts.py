"""Writes the scripts of reports and live pages to a folder, as pages have them, for linters: ``make lint``."""

import sys
from pathlib import Path

from fourbar_codegen.page import live_page
from fourbar_codegen.views import report
from fourbar_codegen.views.html_page import html_file


def main(folder):
    folder.mkdir(parents=True, exist_ok=True)
    for page in (report, live_page):
        name = page.__name__.rpartition(".")[2]
        (folder / f"{name}.js").write_text("\n".join(map(html_file, page.SCRIPTS)), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
