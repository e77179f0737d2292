"""The pictures of a board that a folder holds: which camera took which, and the views they show."""

from pathlib import Path

from rafl.calibration.board import BoardFile, View, find_board

from rafl.common.command_line import progress
from rafl.common.errors import InputError

PICTURES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"}

Views = dict[str, list[View]]
Sizes = dict[str, tuple[int, int]]


def board_views(images: Path, description: BoardFile) -> tuple[Views, Sizes]:
    """The board in every picture, by camera, and the size of each camera's pictures [px].

    A camera is a sub-folder of `images`, or `images` itself where it has none.

    Raises:
        InputError: no pictures, one that cannot be read, of different sizes, or not among those that the description
            names.
    """
    if not images.is_dir():
        raise InputError(f"expected a folder of board pictures at {images}, found none; check the path")
    pictures = _pictures(images)
    _known_pictures(description, pictures, images)
    views, sizes = {}, {}
    for name, names in pictures.items():
        views[name], sizes[name] = _views(name, names, description)
    return views, sizes


def check_placed(views: Views) -> None:
    """Refuses several cameras that nothing ties to one world.

    Raises:
        InputError: a camera that neither sees a board in a known place nor one that another camera sees with it.
    """
    if not _placed(views):
        raise InputError(
            f"camera {list(views)[1]}: with several cameras expected a picture with a known place of the board, found "
            "none; list one per camera under `world` in board.yaml, or say `simultaneous: true` where pictures of one "
            "name were taken together"
        )


def _pictures(images: Path) -> dict[str, dict[str, Path]]:
    """By camera, the pictures by `camera/file`; a folder without sub-folders is one camera."""
    folders = sorted(path for path in images.iterdir() if path.is_dir())
    found = {
        folder.name: {
            f"{folder.name}/{path.name}": path for path in sorted(folder.iterdir()) if path.suffix.lower() in PICTURES
        }
        for folder in folders or [images]
    }
    found = {name: pictures for name, pictures in found.items() if pictures}
    if not found:
        raise InputError(f"expected pictures of the board in {images}/<camera>/, found none; check the path")
    return found


def _known_pictures(description: BoardFile, pictures: dict[str, dict[str, Path]], images: Path) -> None:
    present = {name for names in pictures.values() for name in names}
    named = [(name, "world") for name in description.world]
    named += [(name, "moved") for move in description.moved for name in (move.from_, move.to)]
    for name, key in named:
        if name not in present:
            raise InputError(
                f"board.yaml names {name}, which is not among the pictures in {images}; correct it under `{key}`"
            )


def _placed(views: dict[str, list[View]]) -> bool:
    """Whether every camera is tied to the world, by itself or through boards seen with another."""
    if len(views) == 1:
        return True
    tied = {name for name, own in views.items() if any(view.pose for view in own)}
    boards = {name: {view.board for view in own} for name, own in views.items()}
    known = {view.board for own in views.values() for view in own if view.pose}
    tied |= {name for name in views if boards[name] & known}
    while True:
        more = {name for name in views if name not in tied and any(boards[name] & boards[other] for other in tied)}
        if not more:
            return tied == set(views)
        tied |= more


def _views(camera: str, pictures: dict[str, Path], description: BoardFile) -> tuple[list[View], tuple[int, int]]:
    views: list[View] = []
    sizes: dict[tuple[int, int], str] = {}
    with progress() as bar:
        for name, path in bar.track(pictures.items(), description=f"{camera}: finding the board"):
            view, size = find_board(path, name, description)
            sizes.setdefault(size, name)
            if view is not None:
                views.append(view)
            elif name in description.world:
                raise InputError(
                    f"{path}: board.yaml places the board in it, but it is not to be found there; "
                    "check the pattern in board.yaml, or take the picture again"
                )
    if len(sizes) > 1:
        found = ", ".join(f"{name} {w} x {h}" for (w, h), name in sizes.items())
        raise InputError(f"camera {camera}: expected pictures of one size, found {found}; sort them")
    return views, next(iter(sizes))
