"""Imports run one way, folders stay small, tests mirror the packages, and one module writes files."""

import ast
import re
from functools import cache
from pathlib import Path
from typing import TypeGuard

import pytest
from support import ROOT

# Each layer imports from those that follow it, never from those before it; `|` separates layers that do not import
# each other.
PACKAGES = [
    "review|sweep",
    "api|commands|unit_commands|cli",
    "capture",
    "tracking|physics",
    "calibration",
    "batch",
    "common",
]
TRACKING = ["linking", "video", "detection", "reconstruction"]
INSIDE = {
    "rafl": ["evaluation", "fitting", "residual", "data", "simulation", "solvers", "fem"],
    "tracking": [
        "cli",
        "unit_commands",
        "commands|calibration_commands",
        "rest|report|pipeline",
        "overlay|single_marker",
        "linking",
        "video",
        "detection",
        "reconstruction",
    ],
    "capture": [
        "cli",
        "unit_commands",
        "commands",
        "report",
        "rendering|description",
        "dataset",
        "release",
        "registration",
        "specimen",
    ],
}
FOLDERS = {"rafl": "rafl", "tracking": "rafl.tracking", "capture": "rafl.capture", "calibration": "rafl.calibration"}
MOST_MODULES = 14


@cache
def modules() -> dict[str, Path]:
    """Source files by the name that they are imported as."""
    found = {}
    for folder, name in FOLDERS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join([name, *parts]).removesuffix(".__init__")] = path
    return found


@cache
def imports(path: Path) -> set[str]:
    """Modules of the project that a file imports, also inside functions."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return {name for name in names if name.split(".")[0] == "rafl"} & set(modules())


def rank(layers: list[str], name: str) -> tuple[int, str] | None:
    for number, layer in enumerate(layers):
        if name in layer.split("|"):
            return number, name
    return None


def package(module: str) -> str:
    """The entry of PACKAGES that a module belongs to."""
    second = module.split(".")[1] if "." in module else "api"
    return second if rank(PACKAGES, second) else "physics"


def broken(layers: list[str], pairs: list[tuple[str, str, str, str]]) -> list[str]:
    """The imports that run up, or between layers side by side, of (module, its layer, imported module, its layer)."""
    result = []
    for module, own, imported, other in pairs:
        one, two = rank(layers, own), rank(layers, other)
        if one and two and own != other and two[0] <= one[0] and (own, other) not in SIDE_BY_SIDE:
            result.append(f"{module} -> {imported}")
    return result


# Modules of one layer that work together as one.
SIDE_BY_SIDE = {("cli", "commands"), ("cli", "unit_commands"), ("unit_commands", "cli"), ("commands", "api")}


def test_imports_between_packages_run_down() -> None:
    pairs = [
        (module, package(module), imported, package(imported))
        for module, path in modules().items()
        if module != "rafl"  # the lazy face
        for imported in imports(path)
        if imported != "rafl"
    ]
    assert len(pairs) > 300
    assert broken(PACKAGES, pairs) == []


@pytest.mark.parametrize("folder", INSIDE)
def test_imports_between_subpackages_run_down(folder: str) -> None:
    prefix = FOLDERS[folder] + "."
    pairs = [
        (module, module.removeprefix(prefix).split(".")[0], imported, imported.removeprefix(prefix).split(".")[0])
        for module, path in modules().items()
        if module.startswith(prefix)
        for imported in imports(path)
        if imported.startswith(prefix)
    ]
    assert len(pairs) > 20
    assert broken(INSIDE[folder], pairs) == []


def test_folders_are_small() -> None:
    count: dict[Path, int] = {}
    for path in modules().values():
        count[path.parent] = count.get(path.parent, 0) + 1
    assert {folder.name: number for folder, number in count.items() if number > MOST_MODULES} == {}


def test_tests_mirror_the_packages() -> None:
    """Every folder of tests of a package has the name of a folder of that package."""
    for folder in FOLDERS:
        for path in (ROOT / "tests" / folder).rglob("test_*.py"):
            assert (ROOT / path.parent.relative_to(ROOT / "tests")).is_dir(), path


def test_every_subpackage_is_installed() -> None:
    """pyproject.toml names every folder that has modules."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for module, path in modules().items():
        if path.name == "__init__.py":
            assert f'"{module}",' in text, module


# Modules that write other than through a temporary file that is renamed: the one that does this, the one that makes an
# HDF5 file in memory, the log of running jobs, and the generator of this package's own source.
WRITERS = {"rafl.common.files", "rafl.common.hdf5_files", "rafl.batch.state", "rafl.fem.laws.generated.__main__"}
WRITING_METHODS = {"write_text", "write_bytes", "tofile", "imwrite"}
WRITING_MODE = re.compile(r"[wax][bt+]*|r[bt]*\+[bt]*")


def writes(path: Path) -> list[str]:
    """Calls of a file that write to a path themselves. `av.open` writes films to memory."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            function = node.func
            called = function.attr if isinstance(function, ast.Attribute) else ""
            opened = ast.unparse(function).endswith(("open", "File")) and ast.unparse(function) != "av.open"
            strings = [part.value for part in (*node.args, *(key.value for key in node.keywords)) if is_string(part)]
            if called in WRITING_METHODS or (opened and any(map(WRITING_MODE.fullmatch, strings))):
                found.append(f"{path.name}:{node.lineno}")
    return found


def is_string(node: ast.AST) -> TypeGuard[ast.Constant]:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def test_files_are_written_whole() -> None:
    """Everything goes through `rafl.common.files`, so that a killed program leaves no half of a file."""
    assert {module for module, path in modules().items() if writes(path)} <= WRITERS
    assert writes(modules()["rafl.common.files"])
