"""The attributes of a dataset file that are used: their types and ranges."""

import dataclasses
import math
from typing import Annotated, Any

import pydantic

from rafl.common.yaml_files import describe_validation
from rafl.fem.material import Material


class FileAttributes(pydantic.BaseModel):
    """Attributes of the file that are needed to simulate."""

    model_config = pydantic.ConfigDict(allow_inf_nan=False)

    name: str
    recipe: str
    time_step: float = pydantic.Field(gt=0)
    gravity: tuple[float, float, float]
    integrator: str = "implicit-euler"
    substeps: int = pydantic.Field(default=1, ge=1)


_MATERIAL_FIELDS: dict[str, Any] = {field.name: (field.type, field.default) for field in dataclasses.fields(Material)}
_MATERIAL_FIELDS["law"] = (str, ...)  # always there
MaterialAttributes: type[pydantic.BaseModel] = pydantic.create_model(
    "MaterialAttributes", __config__=pydantic.ConfigDict(extra="forbid", strict=True), **_MATERIAL_FIELDS
)


def _positive_or_nan(value: float) -> float:
    if not (math.isnan(value) or 0.0 < value < math.inf):
        raise ValueError("expected a number above 0, or nan where nothing was measured")
    return value


def _not_negative(value: float) -> float:
    if value < 0.0:
        raise ValueError("expected a number of at least 0, or nan where it is not known")
    return value


_Count = Annotated[int, pydantic.Field(ge=0, strict=True)]
_Measured = Annotated[float, pydantic.Field(strict=True, allow_inf_nan=True), pydantic.AfterValidator(_positive_or_nan)]
_Sigma = Annotated[float, pydantic.Field(strict=True, allow_inf_nan=True), pydantic.AfterValidator(_not_negative)]


class RecordingAttributes(pydantic.BaseModel):
    """Attributes of a recording that are used. Others are kept as they are."""

    model_config = pydantic.ConfigDict(extra="allow", allow_inf_nan=False)

    split: str
    load_g: float | None = pydantic.Field(None, ge=0, strict=True)
    still_frames: _Count = 0
    first_frame: _Count = 0
    not_free_frames: _Count = 0
    registration: str = ""
    bend_modulus: _Measured = float("nan")
    swing_modulus: _Measured = float("nan")
    swing_hz: _Measured = float("nan")
    registration_modulus: _Measured = float("nan")
    registration_modulus_sigma: _Measured = float("nan")
    fit_sigma_mm: tuple[_Sigma, ...] = ()


def check_attributes(model: type[pydantic.BaseModel], attributes: dict[str, Any], label: str) -> None:
    """Check attributes of a part of a file.

    Args:
        model: class that they are validated against.
        attributes: as Python values.
        label: of the part, for the error message.

    Raises:
        ValueError: an attribute is missing, of another type, out of range or not known; the message names it.
    """
    try:
        model.model_validate(attributes)
    except pydantic.ValidationError as error:
        raise ValueError(f"{label}, {describe_validation(error)}") from None
