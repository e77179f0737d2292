"""Atomic writing of files, checks of paths, and hashes."""

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
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`. On success, flush that file to disk and rename it to `path`.

    If writing fails, the temporary file is removed and an earlier file at `path` stays as it was. Temporary files of
    killed programs are removed too.

    Raises:
        InputError: `path` is a folder.
    """
    if path.is_dir():
        raise InputError(f"expected a file to write at {path}, found a folder; name a file in it")
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_stale_files(path)
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


def _remove_stale_files(path: Path) -> None:
    """Remove temporary files for `path` of programs on this machine that no longer run."""
    prefix = f".{path.stem}-{platform.node()}-"
    for temporary in path.parent.glob(f"{glob.escape(prefix)}*-*{glob.escape(path.suffix)}"):
        pid = temporary.name.removeprefix(prefix).split("-")[0]
        if not pid.isdecimal() or os.name == "nt":
            continue
        try:
            os.kill(int(pid), 0)
        except ProcessLookupError:
            temporary.unlink(missing_ok=True)
        except OSError:  # the process runs, and belongs to another user
            continue


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` atomically, as UTF-8."""
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def require_file(path: Path, label: str) -> Path:
    """Return `path` if it is a file. `label` names the expected file in error messages.

    Raises:
        InputError: `path` does not exist, or is a folder.
    """
    if not path.exists():
        raise InputError(f"expected {label} at {path}, found nothing there; check the path")
    if not path.is_file():
        raise InputError(f"expected {label} at {path}, found a folder; name the file itself")
    return path


def require_folder(path: Path, label: str) -> Path:
    """Return `path` if it is a folder. `label` names the expected folder in error messages.

    Raises:
        InputError: `path` does not exist, or is a file.
    """
    if not path.exists():
        raise InputError(f"expected {label} at {path}, found nothing there; check the path")
    if not path.is_dir():
        raise InputError(f"expected {label} at {path}, found a file; name the folder")
    return path


def sha256(path: Path) -> str:
    """SHA-256 of the content of a file, or of all files in a folder in the order of their names."""
    digest = hashlib.sha256()
    for part in sorted(path.iterdir()) if path.is_dir() else [path]:
        if part.is_file():
            with part.open("rb") as stream:
                while block := stream.read(1 << 20):
                    digest.update(block)
    return digest.hexdigest()
