"""Files on disk."""

import errno
import os
from pathlib import Path

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
