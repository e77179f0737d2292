"""The files of a specimen that was described from a recording: specimen.yaml and a picture."""

from pathlib import Path

from rafl.capture.description.describe import Description
from rafl.capture.description.drawing import draw_description
from rafl.capture.description.specimen_text import specimen_text
from rafl.capture.specimen.specimen import Body

PICTURE_SUFFIX = ".png"
UNCERTAIN_MM = 1.0  # a larger standard deviation of a place is worth a note [mm]: rulers are better


def marker_entries(found: Description) -> list[dict[str, object]]:
    """The markers as specimen.yaml lists them, in its order."""
    places, sigmas = 1e3 * found.undeformed.carried.rest + 0.0, 1e3 * found.undeformed.sigma
    return [
        {
            "name": found.names[k],
            "at_mm": [round(float(x), 2) for x in places[k]],
            "at_sigma_mm": round(float(sigmas[k]), 2),
        }
        for k in found.listed
    ]


def specimen_files(
    found: Description, body: Body, still: str, out: Path, density_given: bool
) -> dict[Path, bytes | str]:
    """Contents of specimen.yaml at `out` and of the picture beside it.

    Args:
        found: the dots.
        body: that was described, with the assumed material.
        still: name of the recording's file.
        out: specimen.yaml.
        density_given: whether somebody measured the density.
    """
    assumed = "Poisson's ratio is" if density_given else "density and Poisson's ratio are"
    picture = out.with_suffix(PICTURE_SUFFIX)
    remarks = {
        "": f"Described from {still} by rafl-specimen. Look at {picture.name}.",
        "material": f"To check: {assumed} assumed. Young's modulus {modulus_text(found)}.",
        "clamp": "To check: the face that is held, and the face on which loads hang.",
        "markers": "Places on the undeformed body. A place that you measured better replaces the one found here.",
    }
    text = specimen_text(body.with_material(youngs_modulus=found.youngs_modulus), marker_entries(found), remarks)
    return {picture: draw_description(found, f"{body.name}, from {still}"), out: text}


def modulus_text(found: Description) -> str:
    """Young's modulus with its standard deviation, and where it comes from."""
    modulus, sigma = 1e-3 * found.youngs_modulus, 100.0 * found.undeformed.modulus_sigma
    return f"{modulus:.3g} kPa +- {sigma:.0f} %, {'from the sag' if found.sag_tells else 'assumed'}"


def description_summary(found: Description) -> str:
    """How many dots were found, how well their places are known, and Young's modulus."""
    largest = 1e3 * found.undeformed.sigma.max()
    return f"{len(found.names)} dots, places to {largest:.2f} mm; Young's modulus {modulus_text(found)}"


def description_warnings(found: Description) -> list[str]:
    """A line for each dot that was left out."""
    return [
        f"dot {name} lies {1e3 * distance:.1f} mm off every face and was left out; if it is on the specimen, the size "
        "of the body is wrong"
        for name, distance in found.left_out.items()
    ]


def uncertain_sag(found: Description, lying: bool) -> str:
    """A note if the dots do not tell well how far the specimen sags; empty if they do, or if it lies flat."""
    if lying or 1e3 * found.undeformed.sigma.max() <= UNCERTAIN_MM:
        return ""
    return "the dots do not tell well how far the specimen sags; lay it flat, or measure its Young's modulus"
