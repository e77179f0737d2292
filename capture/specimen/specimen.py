"""Specimens as described in `specimen.yaml`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
import torch
from pydantic import AfterValidator, Field, model_validator

from rafl.capture.specimen.geometry import Geometry
from rafl.common.errors import InputError
from rafl.common.names import Name
from rafl.common.yaml_files import StrictModel, read_yaml
from rafl.data.markers import Markers, embed, embedding_gap
from rafl.fem.laws import LAWS
from rafl.fem.material import PRESET_TIME_INTEGRATION, PRESETS, Material
from rafl.fem.maxwell import branch_shares, branch_times
from rafl.fem.mesh import HexMesh
from rafl.simulation.simulator import Simulator
from rafl.tracking.linking.layout import SPECIMEN_FORMAT, MarkerLayout, MarkerList

DEFAULT_PRESET: Literal["paper", "physical"] = "physical"
# Share of the first cell at the clamp that is cut off where integration is `enhanced`. Nearly incompressible rubber
# contracts sideways within a fraction of the thickness from the clamp, which one cell cannot follow: beams of two and
# three cells across then sag by 6 % too little, with the cut by 1 to 2 %. Shares of 0.25 to 0.35 do equally well.
CLAMP_SPLIT = 0.3
Face = Literal["x-min", "x-max", "y-min", "y-max", "z-min", "z-max"]


def _known_law(name: str) -> str:
    if name not in LAWS:
        raise ValueError(f"Input should be one of {', '.join(LAWS)}")
    return name


class _Branch(StrictModel):
    modulus_share: float = Field(gt=0)
    time_s: float = Field(gt=0)


class _Loss(StrictModel):
    tan_delta: float = Field(gt=0, le=0.5)
    from_hz: float = Field(gt=0)
    to_hz: float = Field(gt=0)

    @model_validator(mode="after")
    def _frequencies_ascend(self) -> "_Loss":
        if self.from_hz >= self.to_hz:
            raise ValueError(f"expected from_hz below to_hz, found {self.from_hz} and {self.to_hz}")
        return self


class _Material(StrictModel):
    youngs_modulus: float = Field(gt=0)
    poissons_ratio: float = Field(gt=-1, lt=0.5)
    density: float = Field(gt=0)
    preset: Literal["paper", "physical"] = DEFAULT_PRESET
    law: Annotated[str, AfterValidator(_known_law)] | None = None
    mass: Literal["uniform", "lumped"] | None = None
    integration: Literal["full", "selective", "enhanced"] | None = None
    mass_damping: float = Field(default=0.0, ge=0)
    stiffness_damping: float = Field(default=0.0, ge=0)
    viscosity: float = Field(default=0.0, ge=0)
    branches: list[_Branch] = Field(default_factory=list)
    loss: _Loss | None = None

    @model_validator(mode="after")
    def _one_description_of_loss(self) -> "_Material":
        if self.branches and self.loss:
            raise ValueError("expected either branches or loss, found both; leave one out")
        return self

    def material(self) -> Material:
        values = self.model_dump(exclude={"preset", "branches", "loss"}, exclude_none=True)
        branches = {
            "branch_shares": tuple(branch.modulus_share for branch in self.branches),
            "branch_times": tuple(branch.time_s for branch in self.branches),
        }
        if self.loss:
            frequencies = (self.loss.from_hz, self.loss.to_hz)
            shares = branch_shares(torch.tensor(self.loss.tan_delta, dtype=torch.float64), *frequencies)
            branches = {"branch_shares": tuple(shares.tolist()), "branch_times": branch_times(*frequencies)}
        return Material(**(PRESETS[self.preset] | values | branches))


class _Simulation(StrictModel):
    integrator: Literal["implicit-euler", "generalised-alpha"] | None = None
    substeps: int | None = Field(default=None, ge=1)


class _Clamp(StrictModel):
    face: Face
    split: float | None = Field(default=None, ge=0, lt=1)
    markers: MarkerList = Field(default_factory=list)


class _Load(StrictModel):
    face: Face


class Body(StrictModel):
    """All of a specimen file but its markers."""

    format: str
    name: Name
    geometry: Geometry
    material: _Material
    clamp: _Clamp
    load: _Load = _Load(face="x-max")
    simulation: _Simulation = _Simulation()

    @model_validator(mode="after")
    def _load_is_not_on_the_clamp(self) -> Self:
        if self.load.face == self.clamp.face:
            raise ValueError(
                f"expected the load on another face than the clamp, found both on {self.clamp.face}; correct load"
            )
        return self

    def with_material(self, **values: float) -> "Body":
        """The body with other values of its material (Young's modulus [Pa], density [kg/m^3]), to four digits."""
        rounded = {key: float(f"{value:.4g}") for key, value in values.items()}
        return self.model_copy(update={"material": self.material.model_copy(update=rounded)})


class SpecimenFile(Body):
    """The content of a specimen file."""

    markers: Annotated[MarkerList, Field(min_length=1)]


@dataclass(frozen=True)
class Specimen:
    """A specimen.

    Attributes:
        name: of the specimen.
        mesh: at rest, in the specimen frame.
        material: assumed material.
        fixed: clamped nodes, (F).
        loaded: nodes that carry a load, (L).
        layout: of the markers on the specimen.
        clamp_layout: of the markers on the clamp; may be empty.
        text: of the file.
        integrator, substeps: time integration of its simulator.
        volume: of the exact shape [m^3].
    """

    name: str
    mesh: HexMesh
    material: Material
    fixed: np.ndarray
    loaded: np.ndarray
    layout: MarkerLayout
    clamp_layout: MarkerLayout
    text: str
    integrator: str
    substeps: int
    volume: float

    def simulator(self, time_step: float, material: Material | None = None) -> Simulator:
        """Simulator with a time step [s]; with the assumed material unless another is given."""
        return Simulator(
            self.mesh,
            material or self.material,
            self.fixed,
            time_step,
            integrator=self.integrator,
            substeps=self.substeps,
        )

    def markers(self, tolerance: float, advice: str = "or allow it with --tolerance-mm") -> Markers:
        """The markers, embedded in the mesh.

        Args:
            tolerance: largest distance of a marker from the surface of the mesh [m].
            advice: end of the error message.

        Raises:
            InputError: a marker is farther than `tolerance` from the surface.
        """
        markers = embed(self.mesh, self.layout.names, self.layout.positions)
        distance = np.maximum(np.abs(markers.normal_offset), embedding_gap(self.mesh, markers))
        if (distance > tolerance).any():
            worst = int(np.argmax(distance))
            raise InputError(
                f"specimen {self.name}: marker {markers.names[worst]} at "
                f"{np.round(1e3 * markers.rest[worst], 3).tolist()} mm lies {1e3 * distance[worst]:.2f} mm off "
                f"the surface, expected at most {1e3 * tolerance:g} mm; correct at_mm, {advice}"
            )
        return markers


def read_specimen(path: str | Path) -> Specimen:
    """Read `specimen.yaml`.

    Raises:
        InputError: the file is missing, damaged or of a newer version, or the shape cannot be meshed.
    """
    path = Path(path)
    content = read_specimen_file(path)
    layout = MarkerLayout.of(content.markers)
    return build_specimen(content, layout, path.parent, path.read_text(encoding="utf-8"))


def read_specimen_file(path: Path) -> SpecimenFile:
    """Read the content of `specimen.yaml` without meshing it.

    Raises:
        InputError: the file is missing, damaged or of a newer version.
    """
    return read_yaml(path, SpecimenFile, "a specimen (specimen.yaml)", SPECIMEN_FORMAT)


def build_specimen(content: Body, layout: MarkerLayout, folder: Path, text: str) -> Specimen:
    """Mesh a described body and take its markers from a layout.

    Args:
        content: of the description.
        layout: of the markers; may be empty.
        folder: that the file of a surface is relative to.
        text: of the description.

    Raises:
        InputError: the shape cannot be meshed.
    """
    solid = content.geometry.build_solid(folder, content.clamp.face)
    material, mesh = content.material.material(), solid.mesh
    split = content.clamp.split
    if split is None:
        split = CLAMP_SPLIT if material.integration == "enhanced" else 0.0
    integrator, substeps = PRESET_TIME_INTEGRATION[content.material.preset]
    if split:
        mesh = mesh.split_layer(mesh.face_nodes(content.clamp.face), split)
    return Specimen(
        content.name,
        mesh,
        material,
        mesh.face_nodes(content.clamp.face),
        mesh.face_nodes(content.load.face),
        layout,
        MarkerLayout.of(content.clamp.markers),
        text,
        content.simulation.integrator or integrator,
        content.simulation.substeps or substeps,
        solid.volume,
    )
