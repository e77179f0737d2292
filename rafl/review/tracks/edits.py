"""What a person does on the page, as corrections."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rafl.common.errors import InputError
from rafl.common.yaml_files import describe_validation
from rafl.review.tracks.recording import OpenRecording
from rafl.tracking.reconstruction.corrections import Accept, Delete, Place, Rename, Swap, path_text
from rafl.tracking.single_marker import PointedDot, dot_at, follow_on

Array = NDArray[Any]

FOLLOWED_ROWS = 25  # by one request; the page asks again until the dot is lost
# Sigma of fits in frames that an encoder predicted from others is at least the usual one of the recording's markers,
# which contains the errors of compression.
MARGIN_SHARE = 0.05  # of the longer side of an image: how far outside a position may be set by hand
DEFAULT_SIGMA_PX = 0.05  # where no marker is seen at all


class Action(BaseModel):
    """A request of the page. `row` and the like are indices along the time of the tracks.

    Attributes:
        kind: what to do.
        camera: of the frame on which it is done.
        marker: name.
        other: second marker's name, or new name.
        row: that is shown.
        last_row: end of the stretch from `row` on.
        x: position [px].
        y: position [px].
        hand: whether the position is taken as it is, rather than that of the dot under it.
        sigma: of a position set by hand [px].
        new: whether the marker is one that the tracker did not find.
        all_cameras: whether the marker is deleted in all cameras.
        entry: index of a correction that was made on other tracks.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    kind: str
    camera: str = ""
    marker: str = ""
    other: str = ""
    row: int = Field(0, ge=0)
    last_row: int = Field(0, ge=0)
    x: float = Field(0.0, ge=-1e5, le=1e5)
    y: float = Field(0.0, ge=-1e5, le=1e5)
    hand: bool = False
    sigma: float = Field(1.0, gt=0.0, le=1000.0)
    new: bool = False
    all_cameras: bool = False
    entry: int = Field(0, ge=0)


def perform(recording: OpenRecording, page: str, action: Action) -> dict[str, object]:
    """Do what a page asks for. The corrections are written before this returns.

    Returns:
        `message` to show, and for a followed marker the last row (`row`), and whether it can be followed on (`more`).

    Raises:
        InputError: the action does not fit the tracks, or no dot is where one is expected.
        ReadOnlyError: another page has the recording.
    """
    with recording.editing:
        recording.require_claim(page)
        if action.kind not in _ACTIONS:
            raise InputError(f"expected one of {', '.join(_ACTIONS)}, found {action.kind!r:.40}; load the page again")
        if action.row >= len(recording.tracks.time):
            raise InputError(f"expected a row below {len(recording.tracks.time)}, found {action.row}")
        try:
            return _ACTIONS[action.kind](recording, action)
        except ValidationError as error:
            raise InputError(describe_validation(error)) from None


def _signature(recording: OpenRecording, camera: str) -> dict[str, Any]:
    return {
        "by": recording.who,
        "at": recording.next_moment(),
        "camera": camera,
        "tracks": recording.found.digest,
    }


def _frame(recording: OpenRecording, camera: str, row: int) -> int:
    if camera not in recording.tracks.frame:
        raise InputError(f"expected a camera of the tracks, found {camera!r:.80}")
    number = int(recording.tracks.frame[camera][row])
    if number < 0:
        raise InputError(f"camera {camera} shows no frame at this time")
    return number


def _frames(recording: OpenRecording, camera: str, row: int, last_row: int) -> tuple[int, int]:
    """First and last frame of a camera in rows `row` to `last_row`."""
    if camera not in recording.tracks.frame:
        raise InputError(f"expected a camera of the tracks, found {camera!r:.80}")
    shown = recording.tracks.frame[camera][row : max(last_row, row) + 1]
    if not (shown >= 0).any():
        raise InputError(f"camera {camera} shows no frame at this time")
    return int(shown[shown >= 0].min()), int(shown.max())


def _dot(recording: OpenRecording, camera: str, row: int, position: Array, marker: str) -> PointedDot:
    """The dot under a position in the frame of a row."""
    image = recording.frames(camera).image(_frame(recording, camera, row))
    if image is None:
        raise InputError("the frame is damaged")
    names, pixel = recording.tracks.names, recording.tracks.in_frames(camera)[0][row]
    others = np.array([name != marker for name in names])
    found = dot_at(image, position, pixel[others])
    if found is None:
        raise InputError("no dot can be fitted there; hold Shift to set the marker by hand")
    return found


def _least_sigma(recording: OpenRecording, camera: str) -> float:
    sigma = recording.raw.pixel_sigma[camera]
    known = sigma[np.isfinite(sigma)]
    return float(np.median(known)) if len(known) else DEFAULT_SIGMA_PX


def _place(recording: OpenRecording, action: Action) -> dict[str, object]:
    frame = _frame(recording, action.camera, action.row)
    position, sigma = np.array([action.x, action.y]), np.full(2, action.sigma)
    message = f"{action.marker} set by hand in frame {frame}"
    if action.hand:
        _check_inside(recording, action)
    else:
        dot = _dot(recording, action.camera, action.row, position, action.marker)
        position, sigma = dot.centre, np.maximum(dot.sigma, _least_sigma(recording, action.camera))
        message = f"{action.marker} fitted in frame {frame}"
        taken = _taken_by(recording, action, dot)
        if taken:
            message += f"; {taken} has this dot too: swap them, or delete {taken} here"
    entry = Place(
        **_signature(recording, action.camera),
        marker=action.marker,
        new=action.new and action.marker not in recording.tracks.names,
        how="hand" if action.hand else "fit",
        path=path_text(np.array([frame]), position[None], sigma[None]),
    )
    recording.add((entry,))
    return {"message": message}


def _check_inside(recording: OpenRecording, action: Action) -> None:
    """Refuse a position that is farther outside the image than a dot that is cut off by its border."""
    rig = recording.rig
    if rig is None or action.camera not in rig.cameras:
        return
    size = np.array(rig.cameras[action.camera].image_size)
    margin, position = MARGIN_SHARE * size.max(), np.array([action.x, action.y])
    if not ((position >= -margin) & (position <= size + margin)).all():
        raise InputError(
            f"expected a position in the image of {size[0]} x {size[1]} px, found ({action.x:.0f}, {action.y:.0f})"
        )


def _taken_by(recording: OpenRecording, action: Action, dot: PointedDot) -> str:
    """The other marker that has a dot already; empty if none has."""
    pixel = recording.tracks.in_frames(action.camera)[0][action.row]
    distance = np.nan_to_num(np.linalg.norm(pixel - dot.centre, axis=1), nan=np.inf)
    for marker in np.argsort(distance)[:2].tolist():
        if distance[marker] < dot.appearance.radius and recording.tracks.names[marker] != action.marker:
            return str(recording.tracks.names[marker])
    return ""


def _follow(recording: OpenRecording, action: Action) -> dict[str, object]:
    tracks = recording.tracks
    if action.marker not in tracks.names or action.camera not in tracks.pixel:
        raise InputError("expected a marker and a camera of the tracks; load the page again")
    marker, path = tracks.names.index(action.marker), tracks.in_frames(action.camera)[0]
    if not np.isfinite(path[action.row, marker, 0]):
        raise InputError(f"{action.marker} has no dot here to follow; set it first")
    start = _dot(recording, action.camera, action.row, path[action.row, marker], action.marker)
    shown, store = tracks.frame[action.camera], recording.frames(action.camera)
    rows = np.arange(action.row, min(action.row + FOLLOWED_ROWS + 1, len(shown)))
    rows = rows[: int(np.argmax(np.r_[shown[rows] < 0, True]))]
    found = list(follow_on(start, marker, path, rows, lambda row: store.image(int(shown[row]))))
    if not found:
        return {"message": f"{action.marker} cannot be followed beyond this frame", "row": action.row, "more": False}
    least = _least_sigma(recording, action.camera)
    frames = np.array([shown[row] for row, _, _ in found])
    text = path_text(
        frames, np.array([centre for _, centre, _ in found]), np.maximum([sigma for _, _, sigma in found], least)
    )
    last = recording.corrections[-1] if recording.corrections else None
    goes_on = (
        isinstance(last, Place)
        and (last.how, last.marker, last.camera) == ("followed", action.marker, action.camera)
        and last.positions[-1, 0] == shown[action.row]
    )
    if goes_on and isinstance(last, Place):
        recording.replace_last(Place(**last.model_dump() | {"path": last.path + text}))
    else:
        signature = _signature(recording, action.camera)
        recording.add((Place(**signature, marker=action.marker, how="followed", path=text),))
    end = found[-1][0]
    more = bool(end == rows[-1] and end + 1 < len(shown))
    return {"message": f"{action.marker} followed to frame {frames[-1]}", "row": end, "more": more}


def _delete(recording: OpenRecording, action: Action) -> dict[str, object]:
    cameras = list(recording.tracks.pixel) if action.all_cameras else [action.camera]
    signature = _signature(recording, action.camera)
    entries = []
    for camera in cameras:
        first, last = _frames(recording, camera, action.row, action.last_row)
        entries.append(Delete(**signature | {"camera": camera}, marker=action.marker, first=first, last=last))
    recording.add(tuple(entries))
    return {"message": f"{action.marker} deleted in frames {first} to {last} of {', '.join(cameras)}"}


def _accept(recording: OpenRecording, action: Action) -> dict[str, object]:
    first, last = _frames(recording, action.camera, action.row, action.last_row)
    signature = _signature(recording, action.camera)
    recording.add((Accept(**signature, marker=action.marker, first=first, last=last),))
    return {"message": f"{action.marker} accepted in frames {first} to {last}"}


def _swap(recording: OpenRecording, action: Action) -> dict[str, object]:
    frame = _frame(recording, action.camera, action.row)
    signature = _signature(recording, action.camera)
    recording.add((Swap(**signature, markers=(action.marker, action.other), first=frame),))
    return {"message": f"{action.marker} and {action.other} swapped from frame {frame} of {action.camera} on"}


def _rename(recording: OpenRecording, action: Action) -> dict[str, object]:
    recording.add((Rename(**_signature(recording, action.camera), marker=action.marker, to=action.other),))
    return {"message": f"{action.marker} is now {action.other}"}


def _undo(recording: OpenRecording, action: Action) -> dict[str, object]:
    return {"message": "taken back" if recording.undo() else "nothing to take back"}


def _redo(recording: OpenRecording, action: Action) -> dict[str, object]:
    return {"message": "made again" if recording.redo() else "nothing to make again"}


def _keep(recording: OpenRecording, action: Action) -> dict[str, object]:
    recording.keep(action.entry)
    return {"message": "the correction holds for these tracks"}


def _drop(recording: OpenRecording, action: Action) -> dict[str, object]:
    recording.drop(action.entry)
    return {"message": "the correction is taken out"}


_ACTIONS: dict[str, Callable[[OpenRecording, Action], dict[str, object]]] = {
    "place": _place,
    "follow": _follow,
    "delete": _delete,
    "accept": _accept,
    "swap": _swap,
    "rename": _rename,
    "undo": _undo,
    "redo": _redo,
    "keep": _keep,
    "drop": _drop,
}
