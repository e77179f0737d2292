"""Board images in a folder: their cameras, and the views of the board that they show."""

from dataclasses import dataclass
from pathlib import Path

from rafl.calibration.board import MIN_POINTS, BoardFile, Detection, View
from rafl.calibration.detection.image_file import image_size, read_grey_image
from rafl.common.command_line import progress
from rafl.common.errors import InputError
from rafl.common.files import find_copies

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"}

Views = dict[str, list[View]]
Sizes = dict[str, tuple[int, int]]


@dataclass(frozen=True)
class FoundBoard:
    """What an image shows of the board.

    Attributes:
        view: None if the image does not serve.
        reason: why it does not; empty if it does.
        detection: what was found.
    """

    view: View | None
    reason: str
    detection: Detection


def board_views(images: Path, description: BoardFile) -> tuple[Views, Sizes]:
    """Views of the board by camera, and the image size of each camera [px].

    Each subfolder of `images` is a camera. Without subfolders, `images` itself is one camera.

    Raises:
        InputError: there are no images, two are the same, an image cannot be read, a camera's images differ in size,
            the description names an image that is not there, or the board has another size than described.
    """
    if not images.is_dir():
        raise InputError(f"expected a folder of board images at {images}, found none; check the path")
    paths = image_paths(images)
    _check_named_images(description, paths, images)
    if copies := find_copies(path for own in paths.values() for path in own.values()):
        raise InputError(f"expected different images, found {copies[0]} in {copies[1]} again; remove one")
    views, sizes = {}, {}
    for name, own in paths.items():
        views[name], sizes[name] = _find_views(name, own, description)
    return views, sizes


def image_path(images: Path, name: str) -> Path:
    """Path of the image `camera/file` in a folder of board images, with or without subfolders."""
    return images / name if (images / name).exists() else images / name.partition("/")[2]


def check_shared_world(views: Views) -> None:
    """Check that all cameras can be calibrated in one world frame.

    Raises:
        InputError: a camera sees neither a board of known pose nor a board pose that a connected camera sees too.
    """
    if not _share_world(views):
        raise InputError(
            f"camera {list(views)[1]}: with several cameras expected an image in which the pose of the board is known, "
            "found none; list one per camera under `world` in board.yaml, or write `simultaneous: true` if images of "
            "the same name were taken at the same time"
        )


def image_paths(images: Path) -> dict[str, dict[str, Path]]:
    """Image paths by camera and by `camera/file`. A folder without subfolders is one camera.

    Raises:
        InputError: there are no images.
    """
    folders = sorted(path for path in images.iterdir() if path.is_dir())
    found = {
        folder.name: {
            f"{folder.name}/{path.name}": path
            for path in sorted(folder.iterdir())
            if path.suffix.lower() in IMAGE_SUFFIXES
        }
        for folder in folders or [images]
    }
    found = {name: paths for name, paths in found.items() if paths}
    if not found:
        raise InputError(f"expected images of the board in {images}/<camera>/, found none; check the path")
    return found


def _check_named_images(description: BoardFile, paths: dict[str, dict[str, Path]], images: Path) -> None:
    present = {name for own in paths.values() for name in own}
    named = [(name, "world") for name in description.world]
    named += [(name, "moved") for move in description.moved for name in (move.from_, move.to)]
    for name, key in named:
        if name not in present:
            raise InputError(
                f"board.yaml names {name}, which is not among the images in {images}; correct it under `{key}`"
            )


def _share_world(views: dict[str, list[View]]) -> bool:
    """Whether every camera sees a board of known pose, or is connected with one that does through shared boards.

    If no pose is known, the first camera's first board is the world.
    """
    if len(views) == 1:
        return True
    connected = {name for name, own in views.items() if any(view.known_pose for view in own)}
    pose_keys = {name: {view.pose_key for view in own} for name, own in views.items()}
    known = {view.pose_key for own in views.values() for view in own if view.known_pose}
    connected = connected or {next(iter(views))}
    connected |= {name for name in views if pose_keys[name] & known}
    while True:
        more = {
            name
            for name in views
            if name not in connected and any(pose_keys[name] & pose_keys[other] for other in connected)
        }
        if not more:
            return connected == set(views)
        connected |= more


def _find_views(camera: str, paths: dict[str, Path], description: BoardFile) -> tuple[list[View], tuple[int, int]]:
    sizes: dict[tuple[int, int], str] = {}
    for name, path in paths.items():
        sizes.setdefault(image_size(path), name)
    if len(sizes) > 1:
        found = ", ".join(f"{name} {w} x {h}" for (w, h), name in sizes.items())
        raise InputError(f"camera {camera}: expected images of one size, found {found}; remove the others")
    views: list[View] = []
    other_size: list[tuple[str, tuple[int, int]]] = []
    with progress() as bar:
        for name, path in bar.track(paths.items(), description=f"{camera}: finding the board"):
            shown = find_board(name, path, description)
            if shown.detection.other_size:
                other_size.append((name, shown.detection.other_size))
            if shown.view is not None:
                views.append(shown.view)
            elif name in description.world:
                raise InputError(
                    f"{path}: board.yaml gives the pose of the board in this image, but {shown.reason}; check the "
                    "pattern in board.yaml, or take the image again"
                )
    if len(other_size) > sum(view.origin_known for view in views):
        name, (columns, rows) = other_size[0]
        raise InputError(
            f"{name}: expected the board that board.yaml describes, found one of {columns} x {rows} points; "
            "correct the pattern in board.yaml (of a chessboard, the inner corners count)"
        )
    return views, next(iter(sizes))


def find_board(name: str, path: Path, description: BoardFile) -> FoundBoard:
    """Find the board in an image.

    Args:
        name: `camera/file`.
        path: of the image.
        description: of the board.

    Raises:
        InputError: the file is damaged, no image, or too large.
    """
    found = description.pattern.find(read_grey_image(path))
    count = len(found.points)
    placed = {*description.world, *(name for move in description.moved for name in (move.from_, move.to))}
    if found.other_size:
        columns, rows = found.other_size
        return FoundBoard(None, f"a board of {columns} x {rows} points was found there", found)
    if not count:
        return FoundBoard(None, "no board was found there", found)
    if count < MIN_POINTS:
        return FoundBoard(None, f"only {count} points of the board were found there, fewer than {MIN_POINTS}", found)
    if not found.origin_known and (description.simultaneous or name in placed):
        return FoundBoard(None, "only a part of a board without its origin was found there", found)
    pose_key = name.partition("/")[2] if description.simultaneous else name
    known = description.world.get(name)
    return FoundBoard(View(name, pose_key, found.points, found.pixels, known, found.origin_known), "", found)
