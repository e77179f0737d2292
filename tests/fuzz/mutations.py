"""Changes to good files, as damage and malice make them: each is a function of a path and a random generator."""

import pickle
import re
import zipfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
import yaml

Random = np.random.Generator
Mutation = Callable[[Path, Random], None]

HOSTILE_NAMES = (
    *("", ".", "..", "../x", "../../x", "/tmp/x", "day1/x", "a\\b", " a", "a ", "a.", ".a", "a\0b", "a\nb", "a\tb"),
    *(
        "a\x1b[31m",
        "\u202ea",
        "A" * 300,
        "é" * 200,
        "[red]x[/red]",
        "[/b]",
        "=cmd|'/c x'!A1",
        "$x^$",
        "a_b%&#{}~^",
        "con",
    ),
    *("\ud800x".encode("utf-8", "replace").decode(), "*", "?", "a:b", "--help", "@", "take2", "TAKE2", "m00", "钢"),
)
HOSTILE_VALUES: tuple[Any, ...] = (
    *(float("nan"), float("inf"), -float("inf"), -1, 0, 1e-320, 1e300, -1e300, 2**63, 10**30, 1.5, 10**6, True),
    *("text", "", None, [], {}, [1], [[[]]], {"a": 1}, ["a"] * 10, "9" * 400, "2026-02-30"),
)
HOSTILE_TEXTS = (
    *(
        "nan",
        "inf",
        "-inf",
        "-1",
        "0",
        "1e308",
        "1e-320",
        "9" * 400,
        "text",
        "",
        "1,5",
        "0x10",
        "1_0",
        "²",
        "=1+1",
        "--1",
    ),
)


def pick(random: Random, options: Any) -> Any:
    """One of several options, unchanged by NumPy."""
    return options[int(random.integers(len(options)))]


def truncate(path: Path, random: Random) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(random.integers(0, len(content)))])


def flip_bits(path: Path, random: Random) -> None:
    content = bytearray(path.read_bytes())
    for _ in range(int(random.integers(1, 9))):
        content[int(random.integers(len(content)))] ^= 1 << int(random.integers(8))
    path.write_bytes(content)


def overwrite(path: Path, random: Random) -> None:
    """Zeros, ones or noise over a block."""
    content = bytearray(path.read_bytes())
    start, length = int(random.integers(len(content))), int(random.integers(1, 600))
    block = pick(random, (bytes(length), b"\xff" * length, random.bytes(length)))
    content[start : start + length] = block
    path.write_bytes(content)


def repeat(path: Path, random: Random) -> None:
    content = path.read_bytes()
    start = int(random.integers(len(content)))
    path.write_bytes(content[: start + int(random.integers(1, 400))] + content[start:])


def replace_file(path: Path, random: Random) -> None:
    """Nothing, noise, a folder or a file of another kind in the file's place."""
    kind = int(random.integers(5))
    path.unlink()
    if kind == 0:
        path.mkdir()
    elif kind == 1:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("x", b"")
    else:
        path.write_bytes(
            pick(random, (b"", random.bytes(700), b"\x89HDF\r\n\x1a\n", b"\0" * 5000, b"{}", b"\xff\xfe" * 40))
        )


def replace_number(path: Path, random: Random) -> None:
    """Another number, or none, for one of a text's numbers."""
    _replace_match(path, random, r"-?\d+(\.\d+)?(e[-+]?\d+)?", HOSTILE_TEXTS)


def replace_word(path: Path, random: Random) -> None:
    """A hostile name for one of a text's words."""
    _replace_match(path, random, r"[A-Za-z]\w*", HOSTILE_NAMES)


def _replace_match(path: Path, random: Random, pattern: str, values: Sequence[str]) -> None:
    text = path.read_text(errors="surrogateescape")
    found = list(re.finditer(pattern, text))
    if found:
        match = found[int(random.integers(len(found)))]
        text = text[: match.start()] + pick(random, values) + text[match.end() :]
    path.write_text(text, errors="surrogateescape")


def change_lines(path: Path, random: Random) -> None:
    """A line left out, repeated, moved or made very long, or another encoding."""
    lines = path.read_text(errors="surrogateescape").splitlines(keepends=True) or [""]
    row = int(random.integers(len(lines)))
    kind = int(random.integers(6))
    if kind == 0:
        del lines[row]
    elif kind == 1:
        lines.insert(row, lines[row])
    elif kind == 2:
        lines = lines[row:] + lines[:row]
    elif kind == 3:
        lines[row] = lines[row].rstrip("\n") + pick(random, (",", "\t", " ", "x", "[", '"')) * 200_000 + "\n"
    elif kind == 4:
        lines = [line.replace(",", pick(random, (";", "\t", ",,"))) for line in lines]
    text = "".join(lines)
    if kind == 5:
        path.write_bytes(text.encode(pick(random, ("utf-16", "utf-8-sig", "utf-7")), errors="replace"))
    else:
        path.write_text(text, errors="surrogateescape")


def _places(content: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) in nested dictionaries and lists."""
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    found = []
    for key, value in items:
        found += [(content, key), *_places(value)]
    return found


def edit_tree(content: Any, random: Random) -> None:
    """Delete, replace, rename or repeat one part of nested dictionaries and lists."""
    container, key = pick(random, _places(content))
    kind = int(random.integers(6))
    if kind == 0:
        del container[key]
    elif kind == 1:
        container[key] = pick(random, HOSTILE_NAMES)
    elif kind == 2 and isinstance(container, dict):
        container[pick(random, (*HOSTILE_NAMES, 1, None))] = container.pop(key)
    elif kind == 3 and isinstance(container, list):
        container.append(container[key])
    else:
        container[key] = pick(random, HOSTILE_VALUES)


def edit_yaml(path: Path, random: Random) -> None:
    content = yaml.safe_load(path.read_text())
    for _ in range(int(random.integers(1, 3))):
        edit_tree(content, random)
    path.write_text(yaml.safe_dump(content, allow_unicode=bool(random.integers(2))))


def yaml_bomb(path: Path, random: Random) -> None:
    """Aliases that stand for billions of values, endless ones, or thousands of brackets."""
    levels = int(random.integers(6, 40))
    lines = ["b0: &b0 [a, a, a, a, a, a, a, a, a]"]
    lines += [f"b{k}: &b{k} [{', '.join([f'*b{k - 1}'] * 9)}]" for k in range(1, levels)]
    nested = "n: " + "[" * int(random.integers(200, 20_000))
    merged = "m: &m {<<: *m}"
    path.write_text(
        path.read_text() + "\n" + pick(random, ("\n".join(lines), "e: &e [*e]", nested, merged, "? [[a]]\n: 1"))
    )


def _objects(file: h5py.File) -> tuple[list[str], list[str]]:
    """Names of the arrays, and of all objects."""
    names: list[str] = []
    file.visititems(lambda name, item: names.append(name))
    return [name for name in names if isinstance(file[name], h5py.Dataset)], names


def _replace(file: h5py.File, name: str, value: Any) -> None:
    del file[name]
    file[name] = value


def change_array(file: h5py.File, random: Random) -> None:
    """Other values, shapes and types for an array."""
    name = pick(random, _objects(file)[0])
    value = file[name][()]
    kind = int(random.integers(9))
    if kind == 0:
        _replace(file, name, np.asarray(value)[..., :0])
    elif kind == 1:
        _replace(file, name, np.asarray(value)[: max(len(value) - 1, 0)] if np.ndim(value) else value)
    elif kind == 2:
        _replace(file, name, np.asarray(value)[None])
    elif kind == 3:
        _replace(file, name, np.asarray(value).astype("S") if value.dtype.kind != "O" else np.arange(len(value)))
    elif kind == 4:
        types = ("f2", "f4", "f8", "i1", "i8", "u8", "c16", "?")
        _replace(file, name, np.zeros(value.shape, value.dtype if value.dtype.kind == "O" else pick(random, types)))
    elif kind == 5:
        _replace(
            file, name, pick(random, (0.0, "text", np.zeros((2, 2)), h5py.Empty("f8"), np.zeros(3, [("a", "f8")])))
        )
    elif value.dtype.kind in "fiu" and value.size:
        numbers = (np.nan, np.inf, -np.inf, -1, 0, 1e300, 1e12, -(2**31), 2**31)
        changed = value.astype(float).ravel()
        count = pick(random, (1, max(changed.size // 2, 1), changed.size))
        changed[random.integers(0, changed.size, count)] = pick(random, numbers)
        with np.errstate(invalid="ignore"):
            _replace(file, name, changed.reshape(value.shape).astype(value.dtype))
    elif value.dtype.kind == "b":
        _replace(file, name, np.zeros_like(value))
    else:
        names = [str(text) for text in file[name].asstr()[()]]
        names[int(random.integers(len(names)))] = pick(random, [text for text in HOSTILE_NAMES if "\0" not in text])
        _replace(file, name, np.array(names, dtype=h5py.string_dtype()))


def change_structure(file: h5py.File, random: Random) -> None:
    """An object left out, renamed, or replaced by a group, a link, a huge array or one stored elsewhere."""
    name = pick(random, _objects(file)[1])
    kind = int(random.integers(9))
    if kind == 0:
        del file[name]
        return
    if kind == 1:
        target = (
            name.rpartition("/")[0] + "/" + pick(random, [text for text in HOSTILE_NAMES if text and "\0" not in text])
        )
        if target.strip("/") not in file and not target.strip("/").startswith(name):
            file.move(name, target)
        return
    del file[name]
    if kind == 2:
        file.create_group(name)
    elif kind == 3:
        file[name] = pick(
            random, (h5py.ExternalLink("/etc/passwd", "/"), h5py.ExternalLink("data.h5", "/mesh/vertices"))
        )
    elif kind == 4:
        file[name] = h5py.SoftLink(pick(random, ("/", f"/{name}", "/nothing")))
    elif kind == 5:
        file.create_dataset(name, (1 << 40, 3), "f8", chunks=(1024, 3))
    elif kind == 6:
        file.create_dataset(name, (1 << 27,), "f8", chunks=(1 << 20,), compression="gzip", fillvalue=1.0)
    elif kind == 7:
        file.create_dataset(name, (4,), "f8", external=[("/etc/hostname", 0, 32)])
    else:
        layout = h5py.VirtualLayout((4,), dtype=float)
        layout[:] = h5py.VirtualSource("elsewhere.h5", "x", (4,))
        file.create_virtual_dataset(name, layout)


def change_attribute(file: h5py.File, random: Random) -> None:
    """An attribute left out, or of another type or value."""
    holders = [(file, key) for key in file.attrs]
    holders += [(file[name], key) for name in _objects(file)[1] for key in file[name].attrs]
    holder, key = pick(random, holders)
    del holder.attrs[key]
    texts = [text for text in HOSTILE_NAMES if "\0" not in text]
    values = (
        np.nan,
        np.inf,
        -1,
        0,
        1e300,
        2**62,
        True,
        np.zeros(3),
        np.zeros((2, 2)),
        "text",
        "",
        np.array(["a", "b"], "S"),
    )
    if random.integers(4):
        holder.attrs[key] = pick(random, values) if random.integers(2) else pick(random, texts)


def edit_hdf5(change: Callable[[h5py.File, Random], None], path: Path, random: Random) -> None:
    """Change an HDF5 file from within."""
    with h5py.File(path, "r+") as file:
        change(file, random)


def edit_npy(path: Path, random: Random) -> None:
    """Other types, shapes and values, an archive, objects, or a header that claims more than there is."""
    array = np.load(path)
    kind = int(random.integers(7))
    if kind == 0:
        with path.open("wb") as stream:
            np.savez(stream, array)
    elif kind == 1:
        with path.open("wb") as stream:
            np.save(stream, np.array([array, "x"], dtype=object), allow_pickle=True)
    elif kind == 2:
        path.write_bytes(path.read_bytes().replace(b"'shape': (", b"'shape': (999999999, ", 1))
    elif kind == 3:
        np.save(
            path,
            pick(random, (array[0], array[:, :0], array[..., :2], array[:1], array[:0], array[None], array.ravel())),
        )
    elif kind == 4:
        np.save(path, array.astype(pick(random, ("f2", "i4", "c16", "S8", "?", "U3", ">f8"))))
    elif kind == 5:
        np.save(path, np.full_like(array, pick(random, (np.nan, np.inf, 0.0, 1e300, 1e9))))
    else:
        array.ravel()[random.integers(0, array.size, array.size // 3)] = pick(random, (np.nan, np.inf, 1e300, -1e9))
        np.save(path, array)


class Planted:
    """An object of a stranger in a file of tensors: to load it would be to run code."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("planted"),)


def edit_tensors(path: Path, random: Random) -> None:
    """Other parts in a file of tensors, code, a package that unpacks to gigabytes, or another format."""
    kind = int(random.integers(8))
    if kind == 0:
        torch.save({"format": "rafl-run/1", "method": "rafl", "field": Planted()}, path)
    elif kind == 1:
        path.write_bytes(pickle.dumps(Planted()))
    elif kind == 2:
        with zipfile.ZipFile(path) as archive:
            parts = {item: archive.read(item) for item in archive.namelist()}
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for item, part in parts.items():
                archive.writestr(item, bytes(200_000_000) if item.endswith("data/0") else part)
    else:
        content = torch.load(path, weights_only=True)
        for _ in range(int(random.integers(1, 3))):
            container, key = pick(random, [(content, key) for key in content] + _places(content))
            if isinstance(
                container.get(key) if isinstance(container, dict) else None, torch.Tensor
            ) and random.integers(2):
                container[key] = pick(
                    random, (container[key][:0], container[key] * np.nan, container[key].int(), torch.zeros(2))
                )
            elif key in container if isinstance(container, dict) else key < len(container):
                edit = pick(random, (*HOSTILE_VALUES, torch.tensor(np.nan), torch.zeros(3)))
                container[key] = edit
        torch.save(content, path)


BYTES: dict[str, Mutation] = {
    "truncate": truncate,
    "flip bits": flip_bits,
    "overwrite": overwrite,
    "repeat": repeat,
    "replace file": replace_file,
}
TEXT: dict[str, Mutation] = {"number": replace_number, "word": replace_word, "lines": change_lines}
# Mutations of each kind of file, by the end of its name.
BY_SUFFIX: dict[str, dict[str, Mutation]] = {
    ".yaml": {**BYTES, **TEXT, "tree": edit_yaml, "tree again": edit_yaml, "bomb": yaml_bomb},
    ".csv": {**BYTES, **TEXT, "number again": replace_number, "word again": replace_word},
    ".trc": {**BYTES, **TEXT},
    ".json": {**BYTES, **TEXT},
    ".h5": {
        **BYTES,
        **{
            f"{change.__name__} {number}": partial(edit_hdf5, change)
            for change in (change_array, change_structure, change_attribute)
            for number in range(3)
        },
    },
    ".npy": {**BYTES, **{f"array {number}": edit_npy for number in range(5)}},
    ".pt": {**BYTES, **{f"tensors {number}": edit_tensors for number in range(5)}},
    ".c3d": BYTES,
    ".mp4": BYTES,
    ".stl": BYTES,
    ".toml": {**BYTES, **TEXT},
    ".yml": {**BYTES, **TEXT},
    ".mat": BYTES,
    ".png": BYTES,
    ".jpg": BYTES,
}
