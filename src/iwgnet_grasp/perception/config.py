"""Reading of the config files of perception and priority."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import yaml

from iwgnet_grasp.perception.types import PerceptionError

Config = TypeVar("Config")


def read_config(path: str | Path, what: str, build: Callable[[Any], Config]) -> Config:
    """What `build` makes of a YAML file's content; `what` is what messages call the file.

    Raises PerceptionError with the file's name for one that is missing or malformed, for a key
    that `build` misses (KeyError) and for a value that it refuses (TypeError, ValueError).
    """
    path = Path(path)
    try:
        return build(yaml.safe_load(path.read_text()))
    except OSError as error:
        raise PerceptionError(f"{path}: cannot be read ({error.strerror})") from error
    except KeyError as error:
        raise PerceptionError(f"{path}: key {error} is missing") from error
    except (yaml.YAMLError, TypeError, ValueError) as error:
        line = " ".join(str(error).split())
        raise PerceptionError(f"{path}: not a valid {what} ({line})") from error
