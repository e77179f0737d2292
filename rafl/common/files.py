"""Files written whole or not at all, and their hashes."""

import glob
import hashlib
import os
import platform
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rafl.common.errors import InputError


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success flush it to disk and rename it over `path`.

    On any failure the temporary file is removed and what stood at `path` is untouched. Temporary files of
    programs that were killed are removed too.

    Raises:
        InputError: a folder stands at `path`.
    """
    if path.is_dir():
        raise InputError(f"expected a file to write at {path}, found a folder; name a file in it")
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_abandoned(path)
    prefix = f".{path.stem}-{platform.node()}-{os.getpid()}-"
    handle, name = tempfile.mkstemp(prefix=prefix, suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        descriptor = os.open(temporary, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _remove_abandoned(path: Path) -> None:
    """Removes temporary files for `path` whose program, of this machine, is no longer there."""
    own = f".{path.stem}-{platform.node()}-"
    for temporary in path.parent.glob(f"{glob.escape(own)}*-*{glob.escape(path.suffix)}"):
        pid = temporary.name.removeprefix(own).split("-")[0]
        if not pid.isdecimal() or os.name == "nt":
            continue
        try:
            os.kill(int(pid), 0)
        except ProcessLookupError:
            temporary.unlink(missing_ok=True)
        except OSError:  # there, and another user's
            continue


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path`, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def require_file(path: Path, what: str) -> Path:
    """Return `path` where it is a readable file; else say what was expected there."""
    if not path.exists():
        raise InputError(f"expected {what} at {path}, found nothing there; check the path")
    if not path.is_file():
        raise InputError(f"expected {what} at {path}, found a folder; name the file itself")
    return path


def require_folder(path: Path, what: str) -> Path:
    """Return `path` if it is a folder.

    Raises:
        InputError: nothing, or a file, is there; the message says that `what` was expected.
    """
    if not path.exists():
        raise InputError(f"expected {what} at {path}, found nothing there; check the path")
    if not path.is_dir():
        raise InputError(f"expected {what} at {path}, found a file; name the folder")
    return path


def sha256(path: Path) -> str:
    """SHA-256 of a file's content; of a folder's files one after another, by name."""
    digest = hashlib.sha256()
    for part in sorted(path.iterdir()) if path.is_dir() else [path]:
        if part.is_file():
            with part.open("rb") as stream:
                while block := stream.read(1 << 20):
                    digest.update(block)
    return digest.hexdigest()
