"""`specimen.yaml`: what a specimen is, and the simulator it is given."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from rafl.capture.specimen.geometry import Geometry
from rafl.tracking.linking.layout import SPECIMEN_FORMAT, MarkerLayout, MarkerList

from rafl.common.errors import InputError
from rafl.common.yaml_files import StrictModel, read_yaml
from rafl.data.markers import Markers, embed, embedding_gap
from rafl.fem.material import PRESETS, Material
from rafl.fem.mesh import HexMesh
from rafl.simulation.simulator import Simulator

DEFAULT_PRESET: Literal["paper", "physical"] = "physical"
Face = Literal["x-min", "x-max", "y-min", "y-max", "z-min", "z-max"]


class _Material(StrictModel):
    youngs_modulus: float = Field(gt=0)
    poissons_ratio: float = Field(gt=-1, lt=0.5)
    density: float = Field(gt=0)
    preset: Literal["paper", "physical"] = DEFAULT_PRESET
    law: Literal["projective", "corotated", "neo-hookean"] | None = None
    mass: Literal["uniform", "lumped"] | None = None
    integration: Literal["full", "selective"] = "full"
    mass_damping: float = Field(default=0.0, ge=0)
    stiffness_damping: float = Field(default=0.0, ge=0)
    viscosity: float = Field(default=0.0, ge=0)

    def material(self) -> Material:
        values = self.model_dump(exclude={"preset"}, exclude_none=True)
        return Material(**(PRESETS[self.preset] | values))


class _Simulation(StrictModel):
    integrator: Literal["implicit-euler", "generalised-alpha"] = "implicit-euler"
    substeps: int = Field(default=1, ge=1)


class _Clamp(StrictModel):
    face: Face
    markers: MarkerList = Field(default_factory=list)


class _Load(StrictModel):
    face: Face


class _SpecimenFile(StrictModel):
    format: str
    name: str = Field(pattern=r"^[\w.-]+$")
    geometry: Geometry
    material: _Material
    clamp: _Clamp
    load: _Load = _Load(face="x-max")
    simulation: _Simulation = _Simulation()
    markers: Annotated[MarkerList, Field(min_length=1)]


@dataclass(frozen=True)
class Specimen:
    """A specimen as described.

    Attributes:
        name: of the specimen.
        mesh: at rest, specimen frame.
        material: assumed.
        fixed: clamped nodes, (F).
        loaded: nodes a load hangs on, (L).
        layout: of the markers on the skin.
        clamp_layout: of the markers on the clamp; may be empty.
        text: of the file.
        integrator, substeps: how its simulator steps in time.
        volume: of the shape that the mesh stands for [m^3].
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
        """A simulator of this specimen, of its assumed material unless another is given."""
        return Simulator(
            self.mesh,
            material or self.material,
            self.fixed,
            time_step,
            integrator=self.integrator,
            substeps=self.substeps,
        )

    def markers(self, tolerance: float, advice: str = "or allow it with --tolerance-mm") -> Markers:
        """The markers tied to the mesh; `advice` ends the message where one cannot be.

        Raises:
            InputError: a marker stands further than `tolerance` [m] off the surface.
        """
        markers = embed(self.mesh, self.layout.names, self.layout.positions)
        off = np.maximum(np.abs(markers.normal_offset), embedding_gap(self.mesh, markers))
        if (off > tolerance).any():
            worst = int(np.argmax(off))
            raise InputError(
                f"specimen {self.name}: marker {markers.names[worst]} at "
                f"{np.round(1e3 * markers.rest[worst], 3).tolist()} mm lies {1e3 * off[worst]:.2f} mm off "
                f"the surface, expected at most {1e3 * tolerance:g} mm; correct at_mm, {advice}"
            )
        return markers


def read_specimen(path: Path) -> Specimen:
    """Read `specimen.yaml`.

    Raises:
        InputError: missing, damaged, of a newer version, or a shape that cannot be meshed.
    """
    content = read_yaml(path, _SpecimenFile, "a specimen (specimen.yaml)", SPECIMEN_FORMAT)
    solid = content.geometry.solid(path.parent, content.clamp.face)
    mesh = solid.mesh
    return Specimen(
        content.name,
        mesh,
        content.material.material(),
        mesh.face_nodes(content.clamp.face),
        mesh.face_nodes(content.load.face),
        MarkerLayout.of(content.markers),
        MarkerLayout.of(content.clamp.markers),
        path.read_text(encoding="utf-8"),
        content.simulation.integrator,
        content.simulation.substeps,
        solid.volume,
    )
