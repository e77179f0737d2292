"""Report of a dataset on one page: mesh, recordings, first frames and registration."""

import jinja2
import matplotlib.pyplot as plt
import numpy as np

from rafl.capture.dataset.camera_summary import CAMERA_HEADINGS, camera_rows
from rafl.capture.dataset.summary import VALID, largest_sigma, load_text, warnings
from rafl.capture.specimen.specimen import Specimen
from rafl.data.dataset import Dataset
from rafl.data.markers import Markers
from rafl.evaluation.figures import draw_specimens

MAX_FRAMES_SHOWN = 9
FRAMES_PER_ROW = 3

PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>{{ name }}</title>
<style>
 body{font:16px/1.5 system-ui,sans-serif;max-width:66rem;margin:2rem auto;padding:0 1rem;color:#222}
 table{border-collapse:collapse;margin:1rem 0;display:block;overflow-x:auto}
 th,td{padding:.25rem .4rem;text-align:right;border-bottom:1px solid #ddd}
 td:first-child,th:first-child{text-align:left;overflow-wrap:anywhere;min-width:5rem}
 .matrix th{overflow-wrap:anywhere;min-width:3.5rem} .lines td{white-space:nowrap} .lines{font-size:.9em}
 img{max-width:100%} .note{color:#666} .worse{color:#c0392b}
</style>
<h1>Dataset {{ name }}</h1>
{% for line in warnings %}<p class="worse">{{ line }}</p>{% endfor %}
<h2>The mesh</h2>
<p>{{ mesh }}</p>
<img alt="mesh with markers" src="data:image/png;base64,{{ mesh_image }}">
<h2>Recordings</h2>
<p class="note">Valid: {{ valid }}. First frame: its number in the film, and what told it. State: whether the specimen
rests in it or moves; of a rest, the frames averaged.</p>
<table><tr><th>recording</th><th>split</th><th>load [g]</th><th>frames</th><th>valid</th><th>first frame</th>
<th>found from</th><th>state</th><th>averaged</th></tr>
{% for row in rows %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}</table>
<p class="note">Registration: largest distance of a marker from its layout position after the transform to the specimen
frame. Fit: root mean square distance between the markers of the mesh fitted to the first frame and the recorded ones.
Sigma: largest standard deviation of a marker of the fitted mesh in any direction; across the line of sight of one
camera it is small, along it only the specimen's shape tells the position. Loaded by: what the shape of the first frame
shows.</p>
<table><tr><th>recording</th><th>registered by</th><th>registration [mm]</th><th>loaded by</th><th>fit [mm]</th>
<th>sigma [mm]</th></tr>
{% for row in fits %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}</table>
{% if cameras %}<h2>Cameras</h2>
<p class="note">How each camera was found to have moved since its calibration, and how late its clock is: turned about
the middle of the markers and shifted, along x, y and z of the specimen, one a line; what to add to its
<code>time_offset_s</code> in calib.yaml, in seconds, and the same in frames; how far the pixels of the markers are from
where the calibration has them; and what no turn, shift or clock explains of the difference between the simulated and
the recorded pixels, beside the standard deviation of these.</p>
<table class="lines"><tr>{% for heading in camera_headings %}<th>{{ heading }}</th>{% endfor %}</tr>
{% for row in cameras %}<tr{% if row.touched or not row.explained %} class="worse"{% endif %}>
{% for lines in row.cells %}<td>{% for line in lines %}{{ line }}<br>{% endfor %}</td>{% endfor %}</tr>{% endfor %}
</table>{% endif %}
<h2>Young's modulus</h2>
<p class="note">Each recording shows it twice: by the bend under the load that was released, and by the frequency of the
swing. The two depend on different quantities: the load, or the frame rate and the density. Rubber is stiffer in a swing
than under a load that hangs for long, up to about 1.3 times. Both numbers are for finding mistakes;
<code>rafl-fit</code> finds the modulus together with the damping. Both take Poisson's ratio
{{ ratio }} from the specimen's description, which has a Young's modulus of {{ assumed }} kPa.
{% if integration != "enhanced" %}Elements of <code>integration: {{ integration }}</code> add a resistance to bending
that depends on Poisson's ratio and on the size of the elements, so the values hold with this ratio on this mesh only.
<code>preset: physical</code> gives the material's own.{% endif %}</p>
<table><tr><th>recording</th><th>bend [kPa]</th><th>swing [kPa]</th><th>frequency [Hz]</th></tr>
{% for row in moduli %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}</table>
<h2>First frames</h2>
<p class="note">Blue: fitted mesh. Red: recorded markers.
{% if not_shown %}{{ not_shown }} more recordings are not shown.{% endif %}</p>
{% for image in first_frames %}<img alt="first frames" src="data:image/png;base64,{{ image }}">{% endfor %}
<h2>First-frame residuals of the markers [mm]</h2>
<table class="matrix"><tr><th>marker</th>{% for name in names %}<th>{{ name }}</th>{% endfor %}</tr>
{% for row in residuals %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}</table>
{% if places %}<h2>Places of the markers</h2>
<p class="note">How far each marker was found from its <code>at_mm</code> on the undeformed body, by the first frames of
all recordings, and the standard deviation, along x, y and z [mm].</p>
<table><tr><th>marker</th><th>x</th><th>y</th><th>z</th><th>sigma x</th><th>sigma y</th><th>sigma z</th></tr>
{% for row in places %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}</table>{% endif %}
<h2>Registration</h2>
<p class="note">Distance of each marker used from its layout position [mm]; sigma of the pose.</p>
<ul>{% for line in registrations %}<li>{{ line }}</li>{% endfor %}</ul></html>
"""


def dataset_page(specimen: Specimen, dataset: Dataset) -> str:
    """The report of a newly built dataset, as HTML."""
    plt.switch_backend("agg")
    mesh, items = dataset.simulator.mesh, dataset.trajectories
    filled = float(mesh.volumes.sum()) / specimen.volume
    shown = [(name, item.q, item.markers[0]) for name, item in items.items()][:MAX_FRAMES_SHOWN]
    residuals = {name: np.asarray(item.attributes["fit_markers_mm"], dtype=float) for name, item in items.items()}
    return (
        jinja2.Environment(autoescape=True)
        .from_string(PAGE)
        .render(
            name=dataset.name,
            warnings=warnings(dataset),
            cameras=camera_rows(dataset),
            mesh=f"{len(mesh.vertices)} vertices, {len(mesh.hexes)} elements, {len(dataset.simulator.fixed)} fixed "
            f"vertices. The elements have {filled:.1%} of the volume of the shape.",
            mesh_image=draw_specimens(mesh, [("at rest", mesh.vertices, dataset.markers.rest)]),
            valid=VALID,
            camera_headings=CAMERA_HEADINGS,
            rows=[_row(name, dataset) for name in items],
            fits=[_fit(name, item.attributes) for name, item in items.items()],
            first_frames=[
                draw_specimens(mesh, shown[k : k + FRAMES_PER_ROW]) for k in range(0, len(shown), FRAMES_PER_ROW)
            ],
            not_shown=len(items) - len(shown),
            names=list(items),
            residuals=[
                [marker, *(f"{values[k]:.3f}" if np.isfinite(values[k]) else "-" for values in residuals.values())]
                for k, marker in enumerate(dataset.markers.names)
            ],
            places=_places(dataset.markers),
            assumed=f"{1e-3 * dataset.simulator.material.youngs_modulus:.3g}",
            ratio=f"{dataset.simulator.material.poissons_ratio:g}",
            integration=dataset.simulator.material.integration,
            moduli=[_moduli(name, item.attributes) for name, item in items.items()],
            registrations=[_registration(name, item.attributes) for name, item in items.items()],
        )
    )


def _row(name: str, dataset: Dataset) -> list[object]:
    item, values = dataset.trajectories[name], dataset.trajectories[name].attributes
    return [
        name,
        item.split,
        load_text(values),
        len(item.time),
        f"{item.valid.mean():.1%}",
        values["first_frame"],
        values["first_frame_from"],
        "moving" if values["initial"] == "moving" else "at rest",
        values["still_frames"],
    ]


def _fit(name: str, values: dict[str, object]) -> list[object]:
    """Row of the table of registrations and first frames."""
    return [
        name,
        values["registration"],
        _measured(float(str(values["registration_residual_mm"])), ".3f"),
        values.get("loading", "-"),
        f"{values['fit_residual_mm']:.3f}",
        _measured(largest_sigma(values), ".2g"),
    ]


def _moduli(name: str, values: dict[str, object]) -> list[str]:
    """Row of the table of moduli; a dash where one cannot be measured."""
    numbers = [float(str(values[key])) for key in ("bend_modulus", "swing_modulus", "swing_hz")]
    scaled = [1e-3 * numbers[0], 1e-3 * numbers[1], numbers[2]]
    return [name, *(_measured(value, ".3g") for value in scaled)]


def _measured(value: float, format_spec: str) -> str:
    """A number, or a dash where nothing was measured."""
    return format(value, format_spec) if np.isfinite(value) else "-"


def _places(markers: Markers) -> list[list[str]]:
    """Rows of the table of places; none if they were not searched."""
    if markers.moved is None or markers.place_sigma is None:
        return []
    values = 1e3 * np.concatenate([markers.moved, markers.place_sigma], axis=1)
    return [[name, *(f"{x:.2f}" for x in row)] for name, row in zip(markers.names, values, strict=True)]


def _registration(name: str, values: dict[str, object]) -> str:
    sigma = np.sqrt(np.diag(np.asarray(values["registration_covariance"], dtype=float)))
    angle, distance = np.degrees(np.linalg.norm(sigma[:3])), 1e3 * np.linalg.norm(sigma[3:])
    accuracy = f"; rotation +- {angle:.3f} degrees, position +- {distance:.3f} mm" if np.isfinite(sigma).all() else ""
    return f"{name}: by {values['registration']}: {values['registration_markers'] or 'no marker needed'}{accuracy}"
