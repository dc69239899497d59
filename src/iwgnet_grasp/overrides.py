"""Changed settings for a run: a copy of config/ in which single keys have other values."""

from __future__ import annotations

import contextlib
import difflib
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml


class OverrideError(ValueError):
    """A --set that cannot be applied; one line."""


def parse_override(text: str) -> tuple[str, Any]:
    """'FILE.KEY[.KEY...]=VALUE' -> (key, value as YAML reads it). Raises OverrideError."""
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or "." not in key or not value.strip():
        raise OverrideError(
            f"--set {text}: is not of the form FILE.KEY=VALUE, such as priority.alpha=0.5"
        )
    try:
        return key, yaml.safe_load(value)
    except yaml.YAMLError:
        raise OverrideError(f"--set {text}: '{value}' is not a YAML value") from None


def parse_overrides(texts: Sequence[str]) -> dict[str, Any]:
    """Several of them; the last of a key counts."""
    return dict(parse_override(text) for text in texts)


@contextlib.contextmanager
def changed_config(config_dir: Path, overrides: Mapping[str, Any]) -> Iterator[Path]:
    """A folder like config_dir with `overrides` (FILE.KEY... -> value) applied; config_dir itself
    when there are none. Removed at the end. Raises OverrideError for a key that does not exist or
    a value of another kind than the one it takes the place of.
    """
    if not overrides:
        yield config_dir
        return
    with tempfile.TemporaryDirectory(prefix="iwgnet_config_") as folder:
        copy = Path(folder) / "config"
        shutil.copytree(config_dir, copy)
        for key, value in overrides.items():
            _apply(copy, key, value)
        yield copy


def _apply(config_dir: Path, key: str, value: Any) -> None:
    name, *steps = key.split(".")
    path = config_dir / f"{name}.yaml"
    if not path.is_file():
        names = sorted(p.stem for p in config_dir.glob("*.yaml"))
        raise OverrideError(f"--set {key}: no file config/{name}.yaml{_nearest(name, names)}")
    content = yaml.safe_load(path.read_text())
    node = content
    for i, step in enumerate(steps):
        if not isinstance(node, dict) or step not in node:
            known = [str(k) for k in node] if isinstance(node, dict) else []
            where = ".".join([name, *steps[:i]])
            raise OverrideError(f"--set {key}: {where} has no key '{step}'{_nearest(step, known)}")
        if i < len(steps) - 1:
            node = node[step]
    old = node[steps[-1]]
    if old is not None and _kind(old) != _kind(value):  # null says nothing of its kind
        raise OverrideError(f"--set {key}={value}: must be {_kind(old)}, as {old!r} is")
    if isinstance(old, float) and isinstance(value, int):
        value = float(value)
    node[steps[-1]] = value
    path.write_text(yaml.safe_dump(content, sort_keys=False))


def _kind(value: Any) -> str:
    if isinstance(value, bool):
        return "true or false"
    if isinstance(value, int | float):
        return "a number"
    if isinstance(value, str):
        return "a text"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return "a group of keys"


def _nearest(word: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, known, 1)
    if close:
        return f"; did you mean '{close[0]}'?"
    return f" (known: {', '.join(known)})" if known else ""
