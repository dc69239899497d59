"""docs/results.md: a page of sections, each written whole by the command that measures it."""

from __future__ import annotations

import re
from pathlib import Path

from iwgnet_grasp.networks.weights import write_whole

PACKAGE = Path(__file__).resolve().parents[3]
PAGE = PACKAGE / "docs" / "results.md"
SECTIONS = ("learning", "trials", "priority", "calibration")  # in the order of the page
_HEAD = "# Results\n\nWritten by the commands named in each section; not edited by hand.\n"


def write_section(name: str, markdown: str, page: Path = PAGE) -> None:
    """Puts a section (its own heading and text) into the page and leaves the others as they are.

    Raises ValueError for a name that is not one of SECTIONS, OSError when the page cannot be
    written.
    """
    if name not in SECTIONS:
        raise ValueError(f"results page: no section '{name}'; known: {', '.join(SECTIONS)}")
    sections = read_sections(page)
    sections[name] = markdown.strip()
    blocks = [
        f"<!-- section {key} -->\n{sections[key]}\n<!-- end -->\n"
        for key in SECTIONS
        if key in sections
    ]
    page.parent.mkdir(parents=True, exist_ok=True)
    write_whole(page, "\n".join([_HEAD, *blocks]).encode())


def read_sections(page: Path = PAGE) -> dict[str, str]:
    """The sections of a page by name; none when there is no page yet."""
    if not page.is_file():
        return {}
    found = re.findall(r"<!-- section (\w+) -->\n(.*?)\n<!-- end -->", page.read_text(), re.S)
    return dict(found)
