"""A specimen as it is described on the page, and written."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.calibration.rig import Rig
from rafl.capture.dataset.sources import recording_of_tracks
from rafl.capture.description.describe import MEASURED_SIGMA, Description, describe
from rafl.capture.description.specimen_files import (
    PICTURE_SUFFIX,
    description_summary,
    description_warnings,
    marker_entries,
    specimen_files,
    uncertain_sag,
)
from rafl.capture.description.specimen_text import body_of_box, specimen_name
from rafl.capture.registration.material_change import MODULUS_SIGMA
from rafl.capture.specimen.specimen import Body, SpecimenFile
from rafl.common.errors import InputError, SimulationError
from rafl.common.files import written_files
from rafl.common.yaml_files import parse_yaml_text
from rafl.fem.mesh import HexMesh
from rafl.review.specimen.corners import projected
from rafl.tracking.linking.layout import SPECIMEN_FORMAT
from rafl.tracking.reconstruction.corrected_tracks import CorrectedTracks

Array = NDArray[Any]


@dataclass(frozen=True)
class BodyForm:
    """What somebody types of a body.

    Attributes:
        size_mm: along x, y and z.
        element_mm: edge of the elements; None to choose it.
        youngs_modulus: [Pa], if measured.
        density: [kg/m^3], if measured.
        lying: whether the specimen lies flat.
        left_out: dots that are none, by their names in the tracks.
    """

    size_mm: tuple[float, float, float]
    element_mm: float | None = None
    youngs_modulus: float | None = None
    density: float | None = None
    lying: bool = False
    left_out: tuple[str, ...] = ()


@dataclass(frozen=True)
class DescribedSpecimen:
    """A specimen that was described, and not yet written.

    Attributes:
        form: what was typed.
        found: the dots and their places.
        still: name of the tracks file.
    """

    form: BodyForm
    found: Description
    still: str

    def shown(self, rig: Rig | None) -> dict[str, object]:
        """What the page shows: names, places, the outline of the body as it hangs, and what to look at."""
        found = self.found
        entries = {str(entry["name"]): entry for entry in marker_entries(found)}
        dots = [
            {"track": track, "name": name, "at_mm": entries[name]["at_mm"], "sigma_mm": entries[name]["at_sigma_mm"]}
            for track, name in zip(found.dots.names, found.names, strict=True)
        ]
        note = uncertain_sag(found, self.form.lying)
        lines = [*description_warnings(found), *([note] if note else [])]
        outline = {} if rig is None else outlines(found.shape.mesh, found.undeformed.q, rig)
        order = [int(k) for k in found.listed]
        return {
            "summary": description_summary(found),
            "warnings": lines,
            "dots": [dots[k] for k in order],
            "outline": outline,
        }


def describe_tracks(tracks: CorrectedTracks, path: Path, form: BodyForm) -> DescribedSpecimen:
    """Describe the specimen that tracks show at rest, as `rafl-specimen` does.

    Args:
        tracks: of the recording.
        path: that they were read from.
        form: the body.

    Raises:
        InputError: the specimen never rests, its dots are not on the body, or the body cannot bear its weight.
    """
    torch.set_num_threads(1)
    body = _body("specimen", form)
    recording = recording_of_tracks(tracks, path)
    names = recording.names or ()
    if unknown := [name for name in form.left_out if name not in names]:
        raise InputError(f"expected dots of {path.stem}, found {unknown[0]!r:.80}; load the page again")
    kept = np.array([name not in form.left_out for name in names])
    recording = replace(
        recording,
        names=tuple(name for name in names if name not in form.left_out),
        position=recording.position[:, kept],
        sigma=recording.sigma[:, kept],
        views={camera: view.select_markers(np.flatnonzero(kept)) for camera, view in recording.views.items()},
    )
    sigma = MODULUS_SIGMA if form.youngs_modulus is None else MEASURED_SIGMA
    try:
        found = describe(recording, body, path.parent, form.lying, path.stem, sigma)
    except SimulationError as error:
        raise InputError(f"the body cannot bear its own weight: {error}; check its size and Young's modulus") from None
    return DescribedSpecimen(form, found, path.name)


def write_specimen(described: DescribedSpecimen, out: Path, replace_files: bool) -> list[Path]:
    """Write specimen.yaml and its picture, both or none.

    Returns:
        The files that are there already, for which somebody must agree that they are replaced; none if it was written.

    Raises:
        InputError: they cannot be written.
    """
    there = [path for path in (out, out.with_suffix(PICTURE_SUFFIX)) if path.exists()]
    if there and not replace_files:
        return there
    body = _body(specimen_name(out), described.form)
    contents = specimen_files(described.found, body, described.still, out, described.form.density is not None)
    parse_yaml_text(str(contents[out]), SpecimenFile, "a specimen (specimen.yaml)", SPECIMEN_FORMAT, out)
    with written_files(contents):
        pass
    return []


def outlines(mesh: HexMesh, q: Array, rig: Rig) -> dict[str, list[list[list[float]]]]:
    """The edges of a box-shaped mesh with its nodes at `q` [m], (N, 3), in each camera [px]."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    edges = []
    for along in range(3):
        others = [axis for axis in range(3) if axis != along]
        for first in (low, high):
            for second in (low, high):
                on_edge = np.isclose(mesh.vertices[:, others[0]], first[others[0]])
                on_edge &= np.isclose(mesh.vertices[:, others[1]], second[others[1]])
                own = np.flatnonzero(on_edge)
                edges.append(q[own[np.argsort(mesh.vertices[own, along])]])
    return projected(edges, rig)


def _body(name: str, form: BodyForm) -> Body:
    body = body_of_box(name, form.size_mm, form.element_mm)
    given = {"youngs_modulus": form.youngs_modulus, "density": form.density}
    return body.with_material(**{key: value for key, value in given.items() if value is not None})
