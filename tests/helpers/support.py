"""Functions and paths that several tests share."""

import os
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from rafl.common.kernels import MESSAGE

ROOT = Path(__file__).parents[2]
SHARED = Path(os.environ.get("SHARED", ROOT.parent / "shared")).resolve()
# A specimen file up to its list of markers.
SMALL_SPECIMEN = """format: rafl-specimen/1
name: small
geometry: {box_mm: [60, 20, 20], element_mm: 10}
material: {youngs_modulus: 150000, poissons_ratio: 0.4, density: 1070, mass: lumped, integration: full}
clamp: {face: x-min}
simulation: {integrator: implicit-euler, substeps: 1}
markers:
"""

RAMP_FRAMES = 12  # frames of the video that `write_video` makes of `ramp_frame`

Run = Callable[..., subprocess.CompletedProcess[str]]


def run_console_script(line: list[str], folder: Path, out: Any, err: Any) -> None:
    """Replace this process by a console script.

    Args:
        line: name of the script and its arguments.
        folder: working folder.
        out, err: file descriptors for standard output and error, as `DupFd`.
    """
    os.chdir(folder)
    for number, handle in ((1, out), (2, err)):
        os.dup2(handle.detach(), number)
    sys.argv = line
    (script,) = entry_points(group="console_scripts", name=line[0])
    sys.exit(script.load()())


def error_lines(stderr: str) -> list[str]:
    """The lines of standard error, but for the message that kernels are compiled."""
    return [line for line in stderr.splitlines() if line.strip() and line != MESSAGE]


def folder_content(folder: Path) -> set[str]:
    """Paths of everything in a folder, relative to it."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def assert_refused(result: subprocess.CompletedProcess[str], *parts: str) -> None:
    """Assert exit code 2 and exactly one line on standard error, an error message that contains all parts."""
    assert result.returncode == 2, result.stdout + result.stderr
    lines = error_lines(result.stderr)
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("error: ")
    for part in parts:
        assert part in lines[0], (part, lines[0])


def draw_frame(
    dots: list[tuple[float, float, float, float, float]],
    size: tuple[int, int] = (200, 160),
    dark: bool = True,
    blur: float = 1.0,
    noise: float = 0.0,
    seed: int = 0,
    contrast: float = 130.0,
) -> np.ndarray:
    """An image of elliptic dots (x, y, long and short semi-axis, angle), averaged from 8 x 8 samples a pixel."""
    n = 8
    cover = np.zeros(size[::-1])
    for x, y, a, b, angle in dots:
        left, top = max(int(x - a) - 2, 0), max(int(y - a) - 2, 0)
        right, bottom = min(int(x + a) + 3, size[0]), min(int(y + a) + 3, size[1])
        fine = [(np.arange(k * n) + 0.5) / n - 0.5 for k in (right - left, bottom - top)]
        u, v = np.meshgrid(fine[0] + left - x, fine[1] + top - y)
        along, across = np.cos(angle) * u + np.sin(angle) * v, -np.sin(angle) * u + np.cos(angle) * v
        inside = ((along / a) ** 2 + (across / b) ** 2 < 1).astype(float)
        part = cv2.resize(inside, (right - left, bottom - top), interpolation=cv2.INTER_AREA)
        cover[top:bottom, left:right] = np.maximum(cover[top:bottom, left:right], part)
    level = (170.0 if dark else 60.0) + (-contrast if dark else contrast) * cv2.GaussianBlur(cover, (0, 0), blur)
    level *= 1.0 + 0.001 * np.arange(size[0])  # brighter towards the right
    return np.clip(np.rint(level + np.random.default_rng(seed).normal(0, noise, level.shape)), 0, 255).astype(np.uint8)


def marker_grid(columns: int = 8, rows: int = 3) -> np.ndarray:
    """Positions (N, 2) [px] of a marker grid with a spacing of 34 px."""
    x, y = np.meshgrid(40 + 34 * np.arange(columns), 80 + 34 * np.arange(rows))
    return np.stack([x, y], axis=-1).reshape(-1, 2).astype(float)


def irregular_outline(random: np.random.Generator, radius: float, roughness: float) -> np.ndarray:
    """Outline (180, 2) [px] of an irregular dot about (0, 0). `roughness` is relative to the radius."""
    angle = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)
    distance = np.full(180, radius)
    for k in range(2, 9):
        distance += radius * roughness * random.normal() / k**0.7 * np.cos(k * angle + random.uniform(0, 2 * np.pi))
    return distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def draw_outlines(outlines: list[np.ndarray], size: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """An image of dark polygons (N, 2) on a light background, blurred by 1 px, with noise.

    The polygons may extend beyond the image border.
    """
    n, pad = 6, 24
    width, height = size[0] + 2 * pad, size[1] + 2 * pad
    fine = np.zeros((height * n, width * n), np.uint8)
    for outline in outlines:
        cv2.fillPoly(fine, [np.rint(((outline + pad + 0.5) * n - 0.5) * 256).astype(np.int32)], 255, shift=8)
    blurred = cv2.GaussianBlur(fine.astype(np.float32) / np.float32(255.0), (0, 0), n)
    share = cv2.resize(blurred, (width, height), interpolation=cv2.INTER_AREA)  # means of n x n samples
    level = 170.0 - 120.0 * share[pad:-pad, pad:-pad]
    return np.clip(np.rint(level + random.normal(0.0, 2.0, level.shape)), 0, 255).astype(np.uint8)


def zero_crossing_frequency(z: np.ndarray, time_step: float) -> float:
    """Frequency [Hz] of an oscillation about zero, from its first to its last upward zero crossing."""
    before = np.flatnonzero((z[:-1] < 0) & (z[1:] >= 0))
    times = time_step * (before + z[before] / (z[before] - z[before + 1]))
    return (len(times) - 1) / (times[-1] - times[0])


def ramp_frame(frame: int) -> np.ndarray:
    """A smooth image that grows lighter with the frame number, with grey levels that every pixel format can store."""
    x, y = np.meshgrid(np.arange(96), np.arange(64))
    return (30 + x + 1.2 * y + 5 * frame).astype(np.uint8)


def write_video(
    path: Path,
    codec: str,
    pixels: str,
    rate: int = 100,
    options: dict[str, str] | None = None,
    frames: list[np.ndarray] | None = None,
    title: str = "",
) -> None:
    """Write a video of grey frames (H, W). The default are the frames of `ramp_frame`."""
    frames = frames or [ramp_frame(number) for number in range(RAMP_FRAMES)]
    with av.open(str(path), "w") as output:
        output.metadata["title"] = title
        stream = output.add_stream(codec, rate=rate)
        stream.height, stream.width = frames[0].shape
        stream.pix_fmt = pixels
        stream.options = options or {}
        for image in frames:
            frame = av.VideoFrame.from_ndarray(image, format="gray")
            output.mux(stream.encode(frame.reformat(format=pixels)))
        output.mux(stream.encode())


def curled_strip(turn: float, pairs: int = 7) -> np.ndarray:
    """Positions (2 * pairs, 2) [px] of marker pairs on a curled strip, 30 px apart.

    The direction of the strip changes by `turn` [rad] from each pair to the next.
    """
    angle = turn * np.arange(pairs)
    step = 30.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    normal = 16.0 * np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    return np.stack([np.cumsum(step, axis=0) + normal, np.cumsum(step, axis=0) - normal], axis=1).reshape(-1, 2)
