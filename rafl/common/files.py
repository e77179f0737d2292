"""Atomic writing of files, checks of paths, and hashes."""

import errno
import glob
import hashlib
import os
import platform
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from rafl.common.errors import InputError

PROBE_BYTES = 65536  # written for a moment to see whether a disk has room; the smallest outputs need as much
PREFIX_CHARACTERS = 30  # of a file's name at the begin of its temporary file's name, at most 120 of 255 bytes


ReadBack = Callable[[Path], object]  # reads a file that was written, and raises InputError if it cannot


@contextmanager
def atomic_file(path: Path, read_back: ReadBack | None = None) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`. On success, flush that file to disk and rename it to `path`.

    If writing fails, the temporary file and the folders made for it are removed, and an earlier file at `path` stays as
    it was. Temporary files of killed programs are removed too.

    Args:
        path: of the file.
        read_back: the reader of such files; the new file takes its place only if this can read it.

    Raises:
        InputError: `path` is a folder, or what was written cannot be read back.
        OSError: the file cannot be written; it has the name `path`.
    """
    if path.is_dir():
        raise InputError(f"expected a file to write at {path}, found a folder; name a file in it")
    with new_folders(path.parent):
        _remove_stale_files(path)
        temporary = _create_temporary_file(path)
        try:
            yield temporary
            descriptor = os.open(temporary, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
            if read_back is not None:
                _check_readable(temporary, path, read_back)
            umask = os.umask(0)
            os.umask(umask)
            temporary.chmod(0o666 & ~umask)
            temporary.replace(path)
        except OSError as error:
            if error.filename not in (None, str(temporary)):
                raise
            raise OSError(error.errno, error.strerror or str(error), str(path)) from None
        finally:
            temporary.unlink(missing_ok=True)


def _check_readable(temporary: Path, path: Path, read_back: ReadBack) -> None:
    try:
        read_back(temporary)
    except InputError as error:
        reason = str(error).replace(str(temporary), "it")
        raise InputError(f"{path}: not written, for it could not be read again: {reason}") from None


@contextmanager
def new_folders(folder: Path) -> Iterator[None]:
    """Make a folder and those above it; remove the new ones if the content fails and leaves them empty."""
    made = [part for part in (folder, *folder.parents) if not part.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for part in made:
            with suppress(OSError):  # it holds something by now, or was never made
                part.rmdir()
        raise


def _create_temporary_file(path: Path) -> Path:
    prefix = f"{_temporary_prefix(path)}{os.getpid()}-"
    try:
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=path.suffix, dir=path.parent)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
    os.close(handle)
    return Path(name)


def _temporary_prefix(path: Path) -> str:
    """Begin of the names of temporary files for `path` of all programs on this machine, short enough for any name."""
    return f".{path.stem[:PREFIX_CHARACTERS]}-{platform.node()}-"


def _remove_stale_files(path: Path) -> None:
    """Remove temporary files for `path` of programs on this machine that no longer run."""
    prefix = _temporary_prefix(path)
    for temporary in path.parent.glob(f"{glob.escape(prefix)}*-*{glob.escape(path.suffix)}"):
        pid = temporary.name.removeprefix(prefix).split("-")[0]
        if not pid.isdecimal() or os.name == "nt":
            continue
        try:
            os.kill(int(pid), 0)
        except (ProcessLookupError, OverflowError):
            temporary.unlink(missing_ok=True)
        except OSError:  # the process runs, and belongs to another user
            continue


def write_bytes(path: Path, content: bytes | memoryview, read_back: ReadBack | None = None) -> None:
    """Write `content` to `path` by `atomic_file`.

    Raises:
        InputError: as `atomic_file` says.
        OSError: the disk has too little space, or as `atomic_file` says.
    """
    with _written_file(path, content, read_back):
        pass


@contextmanager
def _written_file(path: Path, content: bytes | memoryview, read_back: ReadBack | None = None) -> Iterator[None]:
    """A file that is written now, and takes its place when the context ends without an error."""
    with atomic_file(path, read_back) as temporary:
        free = shutil.disk_usage(path.parent).free
        if free < len(content):
            needed = f"expected {len(content) / 1e6:.2f} MB of free space to write it, found {free / 1e6:.2f} MB"
            raise OSError(errno.ENOSPC, needed, str(path))
        temporary.write_bytes(content)
        yield


@contextmanager
def written_files(contents: Mapping[Path, bytes | str]) -> Iterator[None]:
    """Files that are written now, and take their places together when the context ends without an error.

    Raises:
        InputError: as `write_bytes` says; none of the files has changed then.
        OSError: likewise.
    """
    with ExitStack() as stack:
        for path, content in contents.items():
            data = _encoded(content) if isinstance(content, str) else content
            stack.enter_context(_written_file(path, data))
        yield


@contextmanager
def new_content(folder: Path) -> Iterator[None]:
    """A folder that is filled in the context; if that fails, what has come into it is removed."""
    with new_folders(folder):
        before = set(folder.iterdir())
        try:
            yield
        except BaseException:
            for part in set(folder.iterdir()) - before:
                shutil.rmtree(part) if part.is_dir() else part.unlink()
            raise


def _encoded(text: str) -> bytes:
    return text.encode("utf-8", "backslashreplace")


def write_text(path: Path, text: str, read_back: ReadBack | None = None) -> None:
    """Write `text` to `path` by `atomic_file`, as UTF-8."""
    write_bytes(path, _encoded(text), read_back)


def require_writable(path: Path) -> None:
    """Check before a long computation that a file can be written to `path`, or into the folder `path`.

    Raises:
        InputError: the folder, or the one in which it would be made, cannot be written to, or its disk is full.
    """
    folder = next(part for part in (path.absolute(), *path.absolute().parents) if part.exists())
    if folder.is_file():
        if folder != path.absolute():
            raise InputError(f"expected a folder at {folder}, found a file; check the path")
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(PROBE_BYTES))
    except OSError as error:
        raise InputError(
            f"{path}: expected to be able to write there, found: {error.strerror}; free or allow it"
        ) from None


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


def find_copies(paths: Iterable[Path]) -> tuple[Path, Path] | None:
    """Two files of one content among several; None if there are none. Folders do not count."""
    by_size: dict[int, list[Path]] = {}
    for path in paths:
        if path.is_file():
            by_size.setdefault(path.stat().st_size, []).append(path)
    for alike in by_size.values():
        digests = [sha256(path) for path in alike] if len(alike) > 1 else []
        for number, digest in enumerate(digests):
            if digest in digests[:number]:
                return alike[digests.index(digest)], alike[number]
    return None


def sha256(path: Path) -> str:
    """SHA-256 of the content of a file, or of all files in a folder in the order of their names."""
    digest = hashlib.sha256()
    for part in sorted(path.iterdir()) if path.is_dir() else [path]:
        if part.is_file():
            with part.open("rb") as stream:
                while block := stream.read(1 << 20):
                    digest.update(block)
    return digest.hexdigest()
