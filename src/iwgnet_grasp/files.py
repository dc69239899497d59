"""Files on disk."""

import contextlib
import errno
import fcntl
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import yaml

Config = TypeVar("Config")

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def disk_error(error: OSError, place: Path, afterwards: str) -> str:
    """One line: which file or place, why, and what to do when the disk is full."""
    said = f"{error.filename or place}: {error.strerror or error}"
    return f"{said}; make room, then {afterwards}" if error.errno in NO_ROOM else said


def write_whole(path: Path, content: bytes) -> None:
    """Writes beside the file, then renames: a reader never sees half of it. The folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def sole_writer(folder: Path, refusal: type[Exception]) -> Iterator[None]:
    """Makes the folder and locks it as long as the block lasts. Raises `refusal` when another
    process has it."""
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise refusal(f"{folder}: another run is writing it; wait or choose another") from None
        yield
    finally:
        os.close(handle)


def read_config(
    path: str | Path,
    what: str,
    build: Callable[[Any], Config],
    refusal: type[Exception],
) -> Config:
    """What `build` makes of a YAML file's content; `what` is what messages call the file.

    Raises `refusal` with the file's name for one that is missing or malformed, for a key
    that `build` misses (KeyError) and for a value that it refuses (TypeError, ValueError).
    """
    path = Path(path)
    try:
        return build(yaml.safe_load(path.read_text()))
    except OSError as error:
        raise refusal(f"{path}: cannot be read ({error.strerror})") from error
    except KeyError as error:
        raise refusal(f"{path}: key {error} is missing") from error
    except (yaml.YAMLError, TypeError, ValueError) as error:
        line = " ".join(str(error).split())
        raise refusal(f"{path}: not a valid {what} ({line})") from error
