"""A film of a dotted plate that bends, seen by two cameras, with the frame number drawn into every frame."""

from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from scipy.spatial.transform import Rotation
from synthetic import Scene, draw, expose

from rafl.calibration.camera import OrthographicCamera
from rafl.calibration.rig import Rig
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.pipeline import TrackingSettings, track_recording
from rafl.tracking.reconstruction.tracks import Tracks, write_tracks
from rafl.tracking.reconstruction.triangulation import CameraPixels, triangulate
from rafl.tracking.video.recordings import open_videos

SIZE = (400, 320)
SCALE = 5000.0  # px/m
FPS = 50.0
COLUMNS, ROWS, SPACING = 5, 3, 0.012
BITS, BIT_WIDTH, BIT_TOP = 12, 8, 296  # of the frame number: bars along the lower edge, the lowest bit at the left


def camera(angle: float) -> OrthographicCamera:
    """A camera that looks along y, turned about z [rad]."""
    axes = np.array([[np.cos(angle), np.sin(angle), 0], [0, 0, -1], [-np.sin(angle), np.cos(angle), 0]])
    rotation = tuple(Rotation.from_matrix(axes).as_rotvec().tolist())
    centred = OrthographicCamera(image_size=SIZE, scale=(SCALE, SCALE), rotation_vector=rotation, residual=0.05)
    middle = np.array([0.5 * (COLUMNS - 1) * SPACING, 0.0, 0.5 * (ROWS - 1) * SPACING])
    offset = np.array([200.0, 150.0]) - centred.project(middle)
    return replace(centred, offset=tuple(offset.tolist()))


RIG = Rig({"left": camera(0.0), "right": camera(0.6)})
NAMES = tuple(f"{row}{column + 1}" for row in "ABC" for column in range(COLUMNS))
REST = np.array([[SPACING * c, 0.0, SPACING * (ROWS - 1 - r)] for r in range(ROWS) for c in range(COLUMNS)])
LAYOUT = MarkerLayout(NAMES, REST)


def positions(frame: int) -> np.ndarray:
    """Marker positions [m], (M, 3): the plate swings."""
    bend = 0.004 * np.sin(2.0 * np.pi * frame / 40.0) * (REST[:, 0] / REST[:, 0].max()) ** 2
    return REST + np.stack([0.0 * bend, 0.5 * bend, bend], axis=1)


def frame_image(frame: int, name: str, random: np.random.Generator, hidden: tuple[int, ...] = ()) -> np.ndarray:
    """A frame of a camera, (H, W), without the dots of `hidden` markers."""
    pixel = np.delete(RIG.cameras[name].project(positions(frame)), list(hidden), axis=0)
    scene = Scene(size=SIZE, noise=2.0, supersampling=4)
    ellipses = np.column_stack([pixel, np.full((len(pixel), 2), 6.0), np.zeros(len(pixel))])
    image = expose(draw(scene, ellipses, random), scene, random)
    for bit in range(BITS):
        columns = slice(BIT_WIDTH * (bit + 1), BIT_WIDTH * (bit + 2))
        image[BIT_TOP : BIT_TOP + 20, columns] = 250 if frame >> bit & 1 else 10
    return image


def read_counter(image: np.ndarray) -> int:
    """The frame number drawn into an image."""
    levels = [
        image[BIT_TOP + 4 : BIT_TOP + 16, BIT_WIDTH * (bit + 1) + 2 : BIT_WIDTH * (bit + 2) - 2].mean()
        for bit in range(BITS)
    ]
    return sum(int(level > 130) << bit for bit, level in enumerate(levels))


def write_film(path: Path, images: list[np.ndarray], times: np.ndarray | None = None) -> None:
    """Encode images with H.264 and B frames; at times in units of 0.1 ms, or evenly."""
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264", rate=int(FPS))
        stream.height, stream.width = images[0].shape
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "12", "bf": "3", "preset": "veryfast"}
        stream.codec_context.time_base = Fraction(1, 10_000)
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="gray").reformat(format="yuv420p")
            frame.pts = int(times[number]) if times is not None else number * round(10_000 / FPS)
            frame.time_base = Fraction(1, 10_000)
            output.mux(stream.encode(frame))
        output.mux(stream.encode())


@dataclass(frozen=True)
class Film:
    """A tracked recording.

    Attributes:
        folder: with `videos/` and `tracks/`.
        name: of the recording.
        tracks: as tracked.
    """

    folder: Path
    name: str
    tracks: Tracks

    @property
    def path(self) -> Path:
        return self.folder / "tracks" / f"{self.name}.h5"


def make_film(
    folder: Path, name: str = "swing", frames: int = 60, hidden: dict[int, tuple[int, ...]] | None = None
) -> Film:
    """Film and track a recording.

    Args:
        folder: to write into.
        name: of the recording.
        frames: number of them.
        hidden: markers that the left camera does not see, by frame.
    """
    videos = folder / "videos" / name
    videos.mkdir(parents=True)
    for number, camera_name in enumerate(RIG.cameras):
        random = np.random.default_rng(number)
        covered = (hidden or {}) if camera_name == "left" else {}
        images = [frame_image(frame, camera_name, random, covered.get(frame, ())) for frame in range(frames)]
        write_film(videos / f"{camera_name}.mp4", images)
    opened = open_videos({camera_name: videos / f"{camera_name}.mp4" for camera_name in RIG.cameras}, RIG)
    tracks = track_recording(opened, RIG, TrackingSettings(LAYOUT, None, 5), lambda: None)
    film = Film(folder, name, tracks)
    film.path.parent.mkdir(exist_ok=True)
    write_tracks(film.path, tracks)
    return film


def with_swapped(tracks: Tracks, first: str, second: str, row: int, camera_name: str = "left") -> Tracks:
    """The tracks as a tracker writes them that takes two markers for each other in one camera from a row on."""
    pair = [tracks.names.index(first), tracks.names.index(second)]
    changed = {}
    for key in ("pixel", "pixel_sigma"):
        values = dict(getattr(tracks, key))
        values[camera_name] = values[camera_name].copy()
        values[camera_name][row:, pair] = values[camera_name][row:, pair[::-1]]
        changed[key] = values
    pixels = {each: CameraPixels(changed["pixel"][each], changed["pixel_sigma"][each]) for each in tracks.pixel}
    position, sigma, residual = triangulate(RIG, pixels)
    state = np.isfinite(position[..., 0]).astype(np.uint8)
    return replace(tracks, position=position, sigma=sigma, residual=residual, state=state, **changed)
