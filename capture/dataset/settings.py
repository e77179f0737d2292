"""Settings of the building of datasets."""

from dataclasses import dataclass, field
from typing import Literal

from rafl.capture.registration.registration import RestPose


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of `build_dataset`.

    Attributes:
        tolerance: largest distance of a marker from the surface of the mesh [m].
        fit_tolerance: largest root mean square residual of the registration and of the first frame [m].
        fps: frames per second of files without a frame rate.
        rest: frames that show the undeformed specimen, if recorded.
        moving_clamp: express the positions in the frame of the clamp markers, if there are any.
        start: first frame of the recordings whose row has none; None finds it from the motion.
        initial: `rest`: the first frame is an equilibrium; `moving`: it has a velocity; `auto`: either, as each
            recording shows; `sequence`: as `rest`, fitted by a sequence of forces over time.
        forces: virtual forces act on the `tip` or on the whole `surface`.
        unit: of positions in tables that do not name it: m, cm or mm.
        refine_cameras: find from the recordings how the cameras moved, and how late their clocks are, since their
            calibration.
        names: of markers in the specimen, by their names in the files, where they differ.
    """

    tolerance: float = 2e-3
    fit_tolerance: float = 3e-3
    fps: float = 100.0
    rest: RestPose | None = None
    moving_clamp: bool = True
    start: int | None = None
    initial: Literal["auto", "rest", "moving", "sequence"] = "auto"
    forces: Literal["tip", "surface"] = "tip"
    unit: str | None = None
    refine_cameras: bool = False
    names: dict[str, str] = field(default_factory=dict)
