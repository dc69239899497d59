"""What scripts/setup installs is enough for a machine on which nothing was installed by hand."""

import re
from pathlib import Path
from xml.etree import ElementTree

PACKAGE = Path(__file__).resolve().parents[2]
INSTALLED = (PACKAGE / "scripts" / "debian-packages.txt").read_text().split()
DEPENDS = {e.text for e in ElementTree.parse(PACKAGE / "package.xml").iter() if "depend" in e.tag}
INTERFACE = r"\b(?!iwgnet)[a-z0-9_]+_(?:msgs|srvs)\b"  # message packages, as ROS names them
OURS = {path.name for path in (PACKAGE / "interfaces").iterdir()}


def named_in(pattern: str, folders: tuple[str, ...]) -> set[str]:
    files = (path for folder in folders for path in (PACKAGE / folder).rglob("*"))
    texts = (p.read_text() for p in files if p.suffix in (".py", ".msg", ".srv", ".action"))
    return {name for text in texts for name in re.findall(pattern, text, re.MULTILINE)}


def test_every_message_package_that_python_needs_is_installed():
    imported = named_in(rf"^\s*(?:from|import) ({INTERFACE})", ("scripts", "src", "test"))
    in_messages = named_in(rf"^({INTERFACE})/", ("msg", "srv", "action", "interfaces"))
    needed = imported | in_messages
    assert needed and needed <= DEPENDS, "missing in package.xml"
    debian = {f"python3-{name.replace('_', '-')}" for name in needed - OURS}
    assert debian <= set(INSTALLED), "missing in scripts/debian-packages.txt"
